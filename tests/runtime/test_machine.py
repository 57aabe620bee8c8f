"""Cores, memory, torch's threads, and OpenMP's wait policy."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from xrgs.runtime.machine import (
    peak_rss,
    set_passive_openmp_wait,
    set_torch_threads,
    single_torch_thread,
    usable_cores,
)


def test_the_cores_are_those_of_the_affinity() -> None:
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("the system has no processor affinity")
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert usable_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert usable_cores() == len(allowed)


def test_torch_gets_the_threads_or_every_usable_core() -> None:
    before = torch.get_num_threads()
    try:
        assert set_torch_threads(3) == torch.get_num_threads() == 3
        assert set_torch_threads(0) == torch.get_num_threads() == usable_cores()
    finally:
        torch.set_num_threads(before)


def test_a_block_has_one_thread_and_the_others_return_at_its_end() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with single_torch_thread() as threads:
            assert (threads, torch.get_num_threads()) == (3, 1)
        assert torch.get_num_threads() == 3
        with pytest.raises(ZeroDivisionError), single_torch_thread():
            _ = 1 / 0
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_openmps_threads_sleep_unless_the_environment_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    set_passive_openmp_wait()
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    set_passive_openmp_wait()
    assert os.environ["OMP_WAIT_POLICY"] == "active"


@pytest.mark.parametrize(
    "command",
    [
        "from xrgs.sweep.jobs.worker import main; main('none', 'request.json', 'answer.json')",
        "from xrgs.cli.bench import main; main()",
    ],
)
def test_commands_set_the_wait_policy_before_torch_is_imported(
    tmp_path: Path, command: str
) -> None:
    (tmp_path / "request.json").write_text("{}")
    script = f"""
import sys, xrgs.runtime.machine
def recorded():
    assert "torch" not in sys.modules
    print("called")
xrgs.runtime.machine.set_passive_openmp_wait = recorded
sys.argv[1:] = ["--repeats=none"]
{command}
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.startswith("called\n"), done.stderr


@pytest.mark.parametrize(("platform", "unit"), [("linux", 1024), ("darwin", 1)])
def test_the_peak_memory_is_in_bytes(
    platform: str, unit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Usage:
        ru_maxrss = 300_000

    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(resource, "getrusage", lambda *_: Usage)
    assert peak_rss() == 300_000 * unit
