"""The kernels' choice of an instruction set."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

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
