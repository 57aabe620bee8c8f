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

import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest

native = pytest.importorskip("xrgs._native")

PROGRAM = Path(__file__).with_name("hashed_training.py")
HELD = {
    "default": "ad3e1433eb3150748b7e5c3f70563b819bcc91b7c8bb36cac67479b809402b6e",
    "mcmc": "c8923c14d9cc2b9e9dd367655c4c70031169a49ad093c2f714d2605e00c1811f",
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
#: Each instruction set of ours with one of torch's, and the other way round: all pairs would say no
#: more. The libraries' code paths take turns likewise.
PROCESSORS = [
    (WIDE[place % len(WIDE)], CAPABILITIES[place % len(CAPABILITIES)], libraries)
    for place, libraries in zip(
        range(max(len(WIDE), len(CAPABILITIES))),
        itertools.cycle(
            [{"MKL_CBWR": "COMPATIBLE"} | OLD_PROCESSOR, {}, {"MKL_CBWR": "AVX2"} | OLD_PROCESSOR]
        ),
        strict=False,
    )
    if WIDE
]


def hashes(*threads: int, **environment: str) -> list[tuple[str, str]]:
    """The strategy and the hash of each training, by strategy and then by number of threads."""
    done = subprocess.run(
        [sys.executable, "-P", str(PROGRAM), *map(str, threads)],
        env=os.environ | {"OMP_WAIT_POLICY": "passive"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    return [(strategy, found) for strategy, found in lines]


@pytest.mark.slow
def test_the_number_of_threads_changes_no_bit_and_they_are_the_held_ones() -> None:
    found = hashes(2, 3)  # the test below has one
    assert [strategy for strategy, _ in found] == [name for name in HELD for _ in range(2)]
    assert len(set(found)) == len(HELD)
    if native.fused_multiply_add():
        assert dict(found) == HELD, UPDATE


@pytest.mark.skipif(
    not native.fused_multiply_add(), reason="this machine has no fused multiply-add"
)
@pytest.mark.slow
@pytest.mark.parametrize(("isa", "capability", "libraries"), PROCESSORS)
def test_no_processor_changes_a_bit(isa: str, capability: str, libraries: dict[str, str]) -> None:
    found = hashes(1, XRGS_ISA=isa, ATEN_CPU_CAPABILITY=capability, **libraries)
    assert found == list(HELD.items()), UPDATE
