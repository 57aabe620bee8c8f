"""The kernels' choice of an instruction set."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import pytest

from tests.runtime.programs import run_python

_native = pytest.importorskip("xrgs._native")
CPUINFO = Path("/proc/cpuinfo")
#: What the kernel names the instructions that each set of kernels is compiled with.
NEEDED = {
    "portable": set[str](),
    "avx2": {"avx2", "fma", "bmi1", "bmi2", "popcnt"},
    "avx512": {"avx2", "fma", "bmi1", "bmi2", "popcnt"}
    | {"avx512f", "avx512dq", "avx512bw", "avx512vl"},
}


@pytest.mark.skipif(
    platform.machine() != "x86_64" or not CPUINFO.is_file(), reason="needs Linux on x86-64"
)
def test_the_instruction_sets_are_those_that_linux_names() -> None:
    lines = CPUINFO.read_text("utf-8").splitlines()
    flags = set(next(line for line in lines if line.startswith("flags")).split())
    expected = [name for name, needed in NEEDED.items() if needed <= flags]
    assert _native.available_isas() == expected


@pytest.mark.parametrize(("value", "says"), [("portable", "portable"), ("sse9", "XRGS_ISA")])
def test_the_environment_chooses_the_instruction_set(value: str, says: str) -> None:
    script = "from xrgs import _native; print(_native.isa())"
    result = run_python(script, env=os.environ | {"XRGS_ISA": value})
    assert says in (result.stdout if value == "portable" else result.stderr)
