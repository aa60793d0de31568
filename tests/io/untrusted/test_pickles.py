"""Untrusted pickles: known structures are read, nothing is ever called."""

from __future__ import annotations

import io
import os
import pickle
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from tdanet_jax.io.untrusted import FileError, pickles
from tests.support.original import FloatStorage, Tensor, episodes, fake_torch, torch_save

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner)
    | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@given(plain, st.integers(3, 5))  # protocol 2 writes bytes as a call that encodes text
def test_plain_values(value: Any, protocol: int) -> None:
    assert pickles.load(pickle.dumps(value, protocol), "f") == value


numbers = st_numpy.arrays(
    st.sampled_from([np.dtype(code) for code in ("<f4", ">f8", "i8", "u1", "<f2")]),
    st_numpy.array_shapes(max_dims=3, max_side=4),
    elements={"allow_nan": False},
)


@given(numbers, st.integers(0, 5), st.booleans())
def test_arrays(value: np.ndarray, protocol: int, by_column: bool) -> None:
    value = np.asfortranarray(value) if by_column else value
    found = pickles.array(pickles.load(pickle.dumps(value, min(protocol, 4)), "f"), "f")
    np.testing.assert_array_equal(found, value)


def test_files_of_torch_save() -> None:
    with fake_torch():
        matrix, tensor = np.arange(6.0).reshape(2, 3), Tensor(np.arange(9), 1, (2, 3), (1, 2))
        old, held = torch_save(matrix), torch_save({"weights": tensor})
        nested = pickle.dumps([tensor], 3)
    np.testing.assert_array_equal(pickles.array(pickles.load_torch(old, "f"), "f"), matrix)
    expected = [[1, 3, 5], [2, 4, 6]]
    [inner] = pickles.load(nested, "f")
    np.testing.assert_array_equal(pickles.array(inner, "f"), expected)
    weights = pickles.load_torch(held, "f")["weights"]
    np.testing.assert_array_equal(pickles.array(weights, "f"), expected)


def test_the_zip_format_of_torch_save() -> None:
    class Pickler(pickle.Pickler):
        def persistent_id(self, item: Any) -> Any:
            if isinstance(item, FloatStorage):
                return ("storage", FloatStorage, "0", "cpu", len(item.values))
            return None

    with fake_torch():
        out = io.BytesIO()
        Pickler(out, 2).dump(Tensor(np.arange(4), 0, (2, 2), (2, 1)))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("adjmat/data.pkl", out.getvalue())
        archive.writestr("adjmat/data/0", np.arange(4, dtype="<f4").tobytes())
    found = pickles.array(pickles.load_torch(packed.getvalue(), "f"), "f")
    np.testing.assert_array_equal(found, [[0, 1], [2, 3]])
    with pytest.raises(FileError, match=r"f: not a file of torch\.save"):
        pickles.load_torch(packed.getvalue()[:-30], "f")


class Runs:
    """A pickle that would run a command."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.parts = function, arguments

    def __reduce__(self) -> Any:
        return self.parts


def hostile(made: Path) -> list[tuple[Any, str]]:
    return [
        (Runs(os.system, f"touch {made}"), r"(posix|os|nt)\.system"),
        ([{"scene": Runs(eval, "1")}], r"__\.eval|builtins\.eval"),
        (Runs(open, str(made), "w"), r"io\.open|builtins\.open"),
        (Path("x"), r"pathlib"),
        (np.array([print], object), r"print"),
        (np.array(["text"], object), "broken array"),
        (np.array(["text"]), "broken array|_frombuffer"),
    ]


@pytest.mark.parametrize("case", range(7))
def test_what_is_not_on_the_list_is_refused_and_not_called(tmp_path: Path, case: int) -> None:
    made = tmp_path / "made"
    value, reason = hostile(made)[case]
    for protocol in range(2, 6):
        with pytest.raises(FileError, match=f"f: .*({reason})"):
            pickles.array(pickles.load(pickle.dumps(value, protocol), "f"), "f")
    assert not made.exists()


def test_a_command_in_a_tensor_inside_a_list(tmp_path: Path) -> None:
    """The storage's bytes are a pickle of their own."""
    made = tmp_path / "made"
    inner = b"".join(
        pickle.dumps(part, 2)
        for part in (0x1950A86A20F9469CFC6C, 1001, {}, Runs(os.system, f"touch {made}"), [])
    )
    with fake_torch():
        load = sys.modules["torch.storage"]._load_from_bytes
        rebuild = sys.modules["torch._utils"]._rebuild_tensor_v2
        tensor = Runs(rebuild, Runs(load, inner), 0, (1,), (1,), False, OrderedDict())
        data = pickle.dumps([tensor])
    [found] = pickles.load(data, "f")
    with pytest.raises(FileError, match=r"f: .*system"):
        pickles.array(found, "f")
    assert not made.exists()


@pytest.mark.parametrize(
    ("first", "size", "stride"),
    [(0, (10,), (1,)), (8, (2,), (1,)), (0, (2, 2), (1,)), (-1, (1,), (1,)), (0, (1,), (-1,)),
     (0, (2**40,), (0,)), (0, (2**20, 2**20), (0, 0)), (0, (True,), (1,))],
)  # fmt: skip
def test_tensors_stay_within_their_storage(first: int, size: tuple, stride: tuple) -> None:
    with fake_torch():
        data = pickle.dumps(Tensor(np.arange(9), first, size, stride))
    with pytest.raises(FileError, match="f: a broken array"):
        pickles.array(pickles.load(data, "f"), "f")


@pytest.mark.parametrize(
    "data",
    [b"", b".", b"garbage", b"\x80\x04", b"0.", b"(0.", b"h\x05.", b"I1\nI2\nR.", b"]I1\nb.",
     b"I1\n(I2\nu.", b"}(]I1\nu.", b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f.", b"Px\n."],
)  # fmt: skip
def test_broken_pickles(data: bytes) -> None:
    with pytest.raises(FileError, match="f: "):
        pickles.load(data, "f")
    with pytest.raises(FileError, match="f: "):
        pickles.load_torch(data, "f")


def test_an_object_within_itself_is_read() -> None:
    value: list = []
    value.append(value)
    found = pickles.load(pickle.dumps(value), "f")
    assert found[0] is found


def test_states_are_those_of_the_agent() -> None:
    with fake_torch():
        data = pickle.dumps(episodes([("FloorPlan1", 0.25, 90, "Mug")]))
    [record] = pickles.load(data, "f")
    assert record["state"].state["rotation"] == 90
    np.testing.assert_array_equal(pickles.array(record["glove_embedding"], "f"), [2, 3, 4, 5])


def twice_itself(times: int) -> list:
    value: list = [0.5]
    for _ in range(times):
        value = [value, value]
    return value


def test_what_is_shared_is_not_multiplied() -> None:
    """A list that holds another twice, which does so too, has 2^60 numbers in 200 bytes."""
    many, pairs = twice_itself(60), ()
    for _ in range(60):
        pairs = (pairs, pairs)
    reconstruct = np.zeros(1).__reduce__()[0]
    array = pickles.Call(
        f"{reconstruct.__module__}.{reconstruct.__name__}", (),
        (1, (1,), pickles.Call("numpy.dtype", (pairs,), (3, "<")), False, b"1234"),
    )  # fmt: skip
    tensor = pickles.Call(
        "torch._utils._rebuild_tensor_v2",
        (pickles.Call("torch.FloatStorage", (many,)), 0, (1,), (1,)),
    )
    for value in (array, tensor):
        with pytest.raises(FileError, match="f: a broken array"):
            pickles.array(value, "f")


def test_a_tensor_has_at_most_the_numbers_of_its_storage() -> None:
    with fake_torch():
        data = pickle.dumps(Tensor(np.arange(9), 0, (2**12, 2**12), (0, 0)))
    with pytest.raises(FileError, match="f: a broken array"):
        pickles.array(pickles.load(data, "f"), "f")


def test_numbers_and_steps_have_budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = pickles.load(pickle.dumps(np.arange(9.0), 2), "f")
    assert len(pickles.array(numbers, "f", 9)) == 9
    with pytest.raises(FileError, match="f: a broken array"):
        pickles.array(numbers, "f", 8)
    monkeypatch.setenv("TDANET_BUDGETS", "values=100")
    with pytest.raises(FileError, match="f: over 100 steps, more than 100"):
        pickles.load(pickle.dumps([[]] * 200), "f")
