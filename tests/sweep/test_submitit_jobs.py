"""Tests of following submitit's jobs, with a `squeue` that prints what the test says."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("submitit", reason="pip install 'xrgs[submitit]'")

from submitit.slurm.slurm import SlurmJob

from xrgs.sweep import submitit_jobs
from xrgs.sweep.job import INTERRUPTED, WorkError


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """(lines) -> what `squeue` prints from now on; nothing and exit code 1 for an empty text."""
    folder = tmp_path / "bin"
    folder.mkdir()
    command = folder / "squeue"
    command.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\ncat {tmp_path}/queue\n')
    command.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    monkeypatch.setattr(SlurmJob, "_results_timeout_s", 0)
    submitit_jobs.follow()

    def printing(lines: str) -> None:
        (tmp_path / "queue").unlink(missing_ok=True)
        if lines:
            (tmp_path / "queue").write_text(lines)
        SlurmJob.watcher.clear()

    return printing


@pytest.fixture
def job(tmp_path: Path, queue: Callable[[str], None]) -> SlurmJob[Any]:
    """The second job of the array 5."""
    job: SlurmJob[Any] = SlurmJob(tmp_path / "%j", "5_1")
    job.paths.folder.mkdir()
    return job


@pytest.mark.parametrize(
    ("lines", "done"),
    [
        ("5_0 CANCELLED\n5_1 PENDING\n", False),
        ("5_0 CANCELLED\n5_1 CONFIGURING\n", False),
        ("5_1 SUSPENDED\n", False),
        ("5_1 REQUEUE_HOLD\n", False),
        ("5_10 RUNNING\n5_1 TIMEOUT\n", True),
        ("5_1 CANCELLED\n", True),
        ("5_0 RUNNING\n15_1 RUNNING\n", True),  # SLURM has forgotten it
        ("", False),  # SLURM does not answer
    ],
)
def test_a_job_has_ended_when_slurm_will_not_run_it_again(
    job: SlurmJob[Any], queue: Callable[[str], None], tmp_path: Path, lines: str, done: bool
) -> None:
    queue(lines)
    assert job.done(force_check=True) is done
    assert f"--user={os.getuid()} --array --states=all" in (tmp_path / "asked").read_text()


def test_each_job_has_its_own_answer_or_its_own_reason(
    job: SlurmJob[Any], queue: Callable[[str], None]
) -> None:
    queue("5_1 CANCELLED\n")
    (cancelled,) = job.results()
    assert cancelled.return_value == INTERRUPTED
    queue("5_1 NODE_FAIL\n")
    (lost,) = job.results()
    with pytest.raises(WorkError, match=r"job 5_1 \(NODE_FAIL\).*5_1_0_log.err"):
        _ = lost.return_value
    job.paths.result_pickle.write_bytes(pickle.dumps(("success", "an answer")))
    assert job.results() == ["an answer"]
