"""Every instruction set, compiler and number of threads gives the same bits."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent / "same_bits.sh"
COMPILER = os.environ.get("CXX", "c++")


@pytest.mark.slow
@pytest.mark.exhaustive  # compiles all kernels; test_determinism.py runs those that are there
@pytest.mark.skipif(
    shutil.which("cmake") is None or shutil.which(COMPILER) is None,
    reason="needs cmake and a compiler",
)
def test_the_kernels_give_the_held_bits(tmp_path: Path) -> None:
    done = subprocess.run([SCRIPT, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "portable, threads: 3: the same bits" in done.stdout
