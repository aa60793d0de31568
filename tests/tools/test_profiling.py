"""The profile of an update: its operations are sorted into parts, and nothing is lost."""

from __future__ import annotations

from collections import Counter

import pytest

from tdanet_jax.task import make_task
from tdanet_jax.tools import profiling
from tests.conftest import TINY

LOSS = "jit(chunk)/while/body/closed_call/transpose(jvp(ActorCritic))"


@pytest.mark.parametrize(
    ("name", "place", "part"),
    [
        ("ynn_fusion.3", f"{LOSS}/lstm/dot_general", "products"),
        ("dot.4", f"{LOSS}/encoder/linear3/dot_general", "products"),
        ("copy_bitcast_fusion.1", f"{LOSS}/encoder/abs", "copies"),
        ("copy.482", "", "copies"),
        ("fusion", f"{LOSS}/dynamic_update_slice", "copies"),
        ("add_fusion", "jit(chunk)/while/body/optimizer/mul", "optimizer"),
        ("while_fusion", "jit(chunk)/while/body/jit(_gumbel)/jit(_uniform)/add", "random_numbers"),
        ("gather_fusion", "jit(chunk)/while/body/environment/vmap()/gather", "environment"),
        ("add_divide_fusion", f"{LOSS}/lstm/div", "lstm_gates"),
        ("gather_bitcast_fusion", f"{LOSS}/encoder/gather", "lookups"),
        ("exp_fusion", f"{LOSS}/encoder/exp", "encoder"),
        ("reduce", "jit(chunk)/while/body/sub", "other"),
    ],
)
def test_an_operation_belongs_to_one_part(name, place, part):
    assert profiling.part_of(name, place) == part


def test_places_are_read_from_a_program():
    program = """
%fused.1 (p: f32[2]) -> f32[2] {
  ROOT %tanh.2 = f32[2]{0} tanh(%p), metadata={op_name="jit(f)/tanh" stack_frame_id=1}
}
  %copy.3 = f32[2]{0} copy(%x)
  ROOT %while.4 = (f32[2]{0}) while(%t), metadata={op_name="jit(f)/while"}
"""
    expected = {"tanh.2": "jit(f)/tanh", "copy.3": "", "while.4": "jit(f)/while"}
    assert profiling.places(program) == expected


def test_loops_and_other_programs_are_left_out():
    places = {"while.1": "", "call.1": "", "dot.1": "a/dot_general", "add.1": "a/optimizer/add"}
    durations = Counter({"while.1": 100, "call.1": 100, "dot.1": 7, "add.1": 2, "elsewhere": 50})
    assert profiling.sort(durations, places) == {"products": 7, "optimizer": 2}


@pytest.mark.slow
def test_an_update_has_all_parts(some_rooms, glove):
    row = profiling.profile_row(make_task(TINY, some_rooms, glove), TINY.learner)
    assert sum(row[part] for part in profiling.PARTS) == pytest.approx(1, abs=0.01)
    for part in ("products", "optimizer", "random_numbers", "environment", "lstm_gates"):
        assert row[part] > 0
    assert row["milliseconds_per_update"] > 0
