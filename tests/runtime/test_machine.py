"""What of this machine a process may use."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from xrgs.runtime.machine import let_openmp_sleep, usable_cores


def test_cores_are_those_this_process_may_use() -> None:
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("the system has no processor affinity")
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert usable_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert usable_cores() == len(allowed)


def test_openmps_threads_are_told_to_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    let_openmp_sleep()
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    let_openmp_sleep()
    assert os.environ["OMP_WAIT_POLICY"] == "active"


@pytest.mark.parametrize(
    "command",
    [
        "from xrgs.sweep.jobs.worker import main; main('none', 'request.json', 'answer.json')",
        "from xrgs.cli.bench import main; main()",
    ],
)
def test_before_torch_is_there(tmp_path: Path, command: str) -> None:
    (tmp_path / "request.json").write_text("{}")
    script = f"""
import os, sys, xrgs.machine
def note():
    assert "torch" not in sys.modules
    print("told")
xrgs.runtime.machine.let_openmp_sleep = note
sys.argv[1:] = ["repeats=none"]
{command}
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", script],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.startswith("told\n"), done.stderr
