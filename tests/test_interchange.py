"""Own files in other programs and theirs here: benchmarks/interchange installs and runs them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.exhaustive
@pytest.mark.skipif(shutil.which("npm") is None, reason="npm is not installed")
def test_the_tables_of_the_documentation_are_what_the_programs_read() -> None:
    """The versions are in the script. XRGS_INTERCHANGE names a folder that keeps the programs."""
    kept = os.environ.get("XRGS_INTERCHANGE")
    command = [sys.executable, str(ROOT / "benchmarks/interchange/compare.py")]
    command += ["--folder", kept] if kept else []
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (ROOT / "docs/export.md").read_text()
    for table in done.stdout.strip().split("\n\n"):
        assert table in page
