"""Every model compiles for a GPU. Slow: `pytest -m slow tests/system/test_gpu.py`; see gpu.py."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys

import pytest

from tdanet_jax.registry import MODELS
from tests.system import gpu

#: Doubles three numbers in each of five turns of a loop, as XLA prints it.
PROGRAM = """
%double (x: f32[3], i: s32[]) -> f32[3] {
  %x = f32[3]{0} parameter(0)
  %i = s32[] parameter(1)
  ROOT %twice = f32[3]{0} add(%x, %x)
}

%keep (all: f32[5,3], x: f32[3], i: s32[]) -> f32[5,3] {
  %all = f32[5,3]{1,0} parameter(0)
  %x.1 = f32[3]{0} parameter(1)
  %row = f32[1,3]{1,0} bitcast(%x.1)
  %i.1 = s32[] parameter(2)
  %zero = s32[] constant(0)
  ROOT %put = f32[5,3]{1,0} dynamic-update-slice(%all, %row, %i.1, %zero)
}

%body (state: (s32[], f32[3], f32[5,3])) -> (s32[], f32[3], f32[5,3]) {
  %state = (s32[], f32[3]{0}, f32[5,3]{1,0}) parameter(0)
  %i.2 = s32[] get-tuple-element(%state), index=0
  %x.2 = f32[3]{0} get-tuple-element(%state), index=1
  %all.2 = f32[5,3]{1,0} get-tuple-element(%state), index=2
  %doubled = f32[3]{0} fusion(%x.2, %i.2), kind=kLoop, calls=%double
  %kept = f32[5,3]{1,0} fusion(%all.2, %doubled, %i.2), kind=kLoop, calls=%keep
  ROOT %next = (s32[], f32[3]{0}, f32[5,3]{1,0}) tuple(%i.2, %doubled, %kept)
}

ENTRY %main (start: f32[3]) -> f32[5,3] {
  %start = f32[3]{0} parameter(0)
  %first = (s32[], f32[3]{0}, f32[5,3]{1,0}) tuple(%start, %start, %start)
  %loop = (s32[], f32[3]{0}, f32[5,3]{1,0}) while(%first), body=%body, FIVE
  ROOT %out = f32[5,3]{1,0} get-tuple-element(%loop), index=2
}
""".replace("FIVE", 'backend_config={"known_trip_count":{"n":"5"}}')


def test_kernels_and_bytes_of_a_loop():
    # In each turn the first reads x, but i not, and writes x; the second reads x and i and
    # writes a row of all.
    assert list(gpu.kernels(*gpu.parse(PROGRAM))) == [(5, 12 + 12), (5, 12 + 4 + 12)]


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_a_model_compiles_for_a_gpu_and_its_memory_grows_with_the_environments(model):
    if not importlib.util.find_spec("jax_cuda12_plugin"):
        pytest.skip("JAX's CUDA compiler is not installed")
    command = [sys.executable, "-m", "tests.system.gpu", "--models", model]
    counts = ["--num-envs", "64", "1024", "--networks", "2", "20"]
    shipped = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}  # not as tests compile
    done = subprocess.run([*command, *counts], capture_output=True, text=True, env=shipped)
    few, many, two, twenty = map(json.loads, done.stdout.splitlines())
    print(few, many, two, twenty)
    # The same program: as many kernels, but for a few that XLA forms by size.
    assert many["kernels"] < 1.2 * few["kernels"]
    assert 0 < many["gigabytes"] - few["gigabytes"] < 16 * few["gigabytes"]
    assert 0 < twenty["gigabytes"] - two["gigabytes"] < 10 * two["gigabytes"]
