"""Tests that training on the native backend gives the same bits wherever it is computed.

The training is that of `hashed_training.py`, in a process of its own. What is not the same:

- Instruction sets without a fused multiply-add give other bits. A cell's identity says which of the
  two arithmetics it was trained with.
- The similarity to the normalised world (`xrgs.splat.normalize`) is computed in double by numpy's
  BLAS and LAPACK. Its last digits depend on the processor, which the rounding of cameras and points
  to float32 removes from all but a few values in a million.
- Logarithms, cosines and exponentials in double (of spacings, random numbers and `mip`'s result)
  have last digits of their own in each library; the rounding to float32 removes those likewise.
- Scores: the metrics are torch's, whose sums and logarithms depend on the processor in the last
  digits.
- The torch backend.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

native = pytest.importorskip("xrgs._native")

PROGRAM = Path(__file__).with_name("hashed_training.py")
HELD = {
    "default": "95704b2e144d7a40bf03170928a1901e0f146bf7ea678d05c2eacf4a2daa75dd",
    "mcmc": "e5db9095eab05ba5e75b003018105dce3b4d2e793a2c1cc60379ec4d9ab2c86d",
}
"""The hash of the training on every machine with a fused multiply-add, by strategy."""
UPDATE = (
    "the training of tests/training/hashed_training.py does not give the bits that HELD stands for."
    " If you have changed what training computes, on purpose, put the new hash into HELD, and let"
    " the tests marked slow show that it does not depend on the machine. If you have not, this"
    " machine, or a library on it, computes something else than others do: find out what."
)
#: The instruction sets that torch can be told to use; of one that the machine lacks it crashes.
CAPABILITIES = sorted({"default"} | {"avx2", "avx512"}.intersection(native.available_isas()))
WIDE = [isa for isa in native.available_isas() if isa != "portable"]
#: What numpy, oneDNN and libm compute with on an old processor.
OLD_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
}
LIBRARIES = [{"MKL_CBWR": "COMPATIBLE"} | OLD_PROCESSOR, {}, {"MKL_CBWR": "AVX2"} | OLD_PROCESSOR]
PLACES = max(len(WIDE), len(CAPABILITIES)) if WIDE else 1
#: Each instruction set of ours with one of torch's, and the other way round: all pairs would say no
#: more. The libraries' code paths and the numbers of threads take turns likewise.
PROCESSORS = [
    pytest.param(
        {
            "XRGS_ISA": WIDE[place % len(WIDE)] if WIDE else "portable",
            "ATEN_CPU_CAPABILITY": CAPABILITIES[place % len(CAPABILITIES)],
            **LIBRARIES[place % len(LIBRARIES)],
        },
        [number for number in (1, 2) if (number - 1) % PLACES == place],
        # Who has the others has no processor without them, and trains as they do.
        marks=pytest.mark.exhaustive
        if place and CAPABILITIES[place % len(CAPABILITIES)] == "default"
        else (),
    )
    for place in range(PLACES)
]


@pytest.mark.slow
@pytest.mark.parametrize(("environment", "threads"), PROCESSORS)
def test_no_processor_and_no_number_of_threads_changes_a_bit(
    environment: dict[str, str], threads: list[int]
) -> None:
    done = subprocess.run(
        [sys.executable, "-P", str(PROGRAM), *map(str, threads)],
        env=os.environ | {"OMP_WAIT_POLICY": "passive"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [strategy for strategy, _ in lines] == [name for name in HELD for _ in threads]
    assert len({found for _, found in lines}) == len(HELD)
    if native.fused_multiply_add():
        assert dict(lines) == HELD, UPDATE
