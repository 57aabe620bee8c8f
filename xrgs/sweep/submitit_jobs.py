"""Follows the jobs of submitit's launchers one by one, and SLURM's jobs by its queue.

submitit raises at the first job that ends without an answer, and loses all other answers. It
learns the end of a SLURM job from `sacct`, up to ten minutes late; where SLURM has no accounting,
`sacct` does not answer, and submitit would wait for a killed job without end.
"""

from __future__ import annotations

import os
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from submitit.core.core import Job
from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

from xrgs.sweep.job import INTERRUPTED, WorkError

#: Seconds between two looks at SLURM's queue, which remembers ended jobs for five minutes.
_LOOK_S = 30
#: State of a job that SLURM no longer lists: it has ended, or was cancelled while it waited.
_NOT_LISTED = "not in the queue"
#: States of SLURM jobs that have ended and will not run again; in others they may yet answer.
_ENDED = frozenset(
    {"BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY"}
    | {"PREEMPTED", "REVOKED", "TIMEOUT", _NOT_LISTED}
)


class QueueWatcher(SlurmInfoWatcher):
    """Knows the states of SLURM jobs from `squeue`, which every SLURM has."""

    def _make_command(self) -> list[str] | None:
        if not self._registered - self._finished:
            return None
        # Not by the jobs' ids: squeue refuses one that SLURM has forgotten.
        user = f"--user={os.getuid()}"
        return ["squeue", user, "--array", "--states=all", "--noheader", "--format=%i %T"]

    def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
        """Return the states of the followed jobs by their ids, from the output of `squeue`."""
        text = string if isinstance(string, str) else string.decode()
        states = dict(line.split() for line in text.splitlines())
        followed = self._registered - self._finished
        return {job: {"State": states.get(job, _NOT_LISTED)} for job in followed}

    def is_done(self, job_id: str, mode: str = "standard") -> bool:
        """Return whether a job has ended and will not run again; `mode` as in submitit."""
        return self.get_state(job_id, mode=mode) in _ENDED


def follow() -> None:
    """Make submitit follow each job of this process by itself."""
    SlurmJob.watcher = QueueWatcher(delay_s=_LOOK_S)
    # The launcher calls nothing else of a job. A job returns a `JobReturn` of Hydra.
    Job.results = _results  # type: ignore[assignment, method-assign]


def _results(job: Job[Any], wait: Any = Job.results) -> list[JobReturn]:
    """Return a job's answer, or an outcome in its place if the job gave none."""
    try:
        return list(wait(job))
    except Exception:
        if job.state == "CANCELLED":
            return [JobReturn(status=JobStatus.COMPLETED, _return_value=INTERRUPTED)]
        reason = f"job {job.job_id} ({job.state}) gave no answer; its log is {job.paths.stderr}"
        return [JobReturn([job.job_id], status=JobStatus.FAILED, _return_value=WorkError(reason))]
