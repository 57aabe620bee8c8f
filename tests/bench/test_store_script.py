"""`benchmarks/store.py` runs: every command is measured over cells that count as done."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "store.py"


@pytest.mark.exhaustive  # half a minute, for a script outside the package
def test_every_command_is_measured(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "10"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    _, *rows = done.stdout.splitlines()
    assert len(rows) == 5
    assert all(float(row.split()[-2]) > 0 for row in rows)
    assert not list(tmp_path.iterdir())
