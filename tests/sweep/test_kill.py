"""Tests that a sweep killed by `kill -9` ends as if it had not been killed.

`XRGS_KILLS=20 pytest tests/sweep/test_kill.py -m exhaustive --log-cli-level=info` kills 20 times at
random moments and logs each; with `XRGS_KILL_SEED=N` besides, it draws the same moments as the run
that printed this seed.
"""

from __future__ import annotations

import json
import logging
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import work_here
from xrgs.store import cell
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store
from xrgs.sweep import job

pytestmark = pytest.mark.slow

_log = logging.getLogger(__name__)

#: Two cells. A checkpoint after nearly every step makes training long enough to be hit.
ARGUMENTS = (
    "scene=motorcycle",
    "preset=smoke",
    "train.steps=25",
    "+ablation=xrgs",
    "checkpoint_s=0.001",
    "retry=failed",
    "fail_fast=true",
)
CELLS = 2
#: Python runs this in every process of a sweep: no report is made, which takes as long as all else.
NO_REPORT = """
import sys, types
sys.modules["xrgs.report"] = types.ModuleType("xrgs.report")
sys.modules["xrgs.report"].build = lambda *_: types.SimpleNamespace(text="")
"""
#: The phases of a sweep in order: the file that each writes first, and about how many seconds it
#: takes. The phases from `start` to `finish` are those of each cell.
PHASES = {
    "plan": ("-", 0.5),
    "build": ("variants/.*.building", 2.0),
    "start": ("cells/*/config.json", 2.0),
    "train": ("cells/*/checkpoint.npz", 0.5),
    "evaluate": ("cells/*/renders", 0.1),
    "finish": ("cells/*/scores.csv", 0.02),
    "report": ("reports/*", 1.0),
}


@dataclass(frozen=True, order=True)
class Moment:
    """When to kill, and which process; ordered as a sweep reaches them over all its restarts."""

    done: int
    """Number of cells that are done."""
    phase: int
    later: float
    """Seconds since the phase began."""
    worker: bool
    """Whether to kill the child that builds or trains, if there is one; else the sweep."""

    @property
    def phase_name(self) -> str:
        return list(PHASES)[self.phase]


def drawn(count: int, chance: random.Random) -> list[Moment]:
    """Return random moments; no phase is hit twice before all are hit.

    The first one drawn kills a worker soon after its first checkpoint, on a fast machine too: from
    there, training has to resume. Where moments are few, none is in a build or a report.
    """
    places = [name for name in PHASES if count > len(PHASES) or name not in ("build", "report")]
    turns = ["train", *chance.sample([name for name in places if name != "train"], len(places) - 1)]
    moments = []
    for turn in range(count):
        name = turns[turn % len(turns)]
        done = {"build": 0, "report": CELLS}.get(name, chance.randrange(CELLS))
        longest, worker = PHASES[name][1], chance.random() < 0.5
        if turn == 0:
            longest, worker = 0.05, True
        moments.append(Moment(done, list(PHASES).index(name), chance.uniform(0, longest), worker))
    return sorted(moments)


class KilledSweeps:
    """A store whose sweeps are killed, and the cells that were done before each kill."""

    def __init__(self, sweeps: Any) -> None:
        self.sweeps = sweeps
        self.store = sweeps.folder / "s"
        self.finished: dict[str, dict[str, tuple[int, ...]]] = {}

    def done(self) -> list[Path]:
        """Folders of the cells that say that they are done."""
        found = []
        for status in self.store.glob("cells/*/status.json"):
            with suppress(FileNotFoundError):  # set aside just now
                if json.loads(status.read_text())["state"] == "done":
                    found.append(status.parent)
        return found

    def check(self) -> None:
        """Assert that what was done is as it was: the same files, not written again."""
        now = {done.name: contents(done) for done in self.done()}
        for name, files in self.finished.items():
            assert now[name] == files
        self.finished = now

    def kill(self, moment: Moment) -> str:
        """Start a sweep and kill it; return what was killed, or nothing if it ended before."""
        before, done = self._signs(moment), len(self.done())
        sweep = self.sweeps.start(*ARGUMENTS)
        while sweep.process.poll() is None and not self._is_at(moment, before):
            time.sleep(0.01)
        time.sleep(moment.later)
        if sweep.process.poll() is not None:
            return ""
        workers = {
            pid: line.split()[-2:]
            for pid, line in self.sweeps.processes().items()
            if "xrgs.sweep.job" in line
        }
        victim = next(iter(workers), 0) if moment.worker else 0
        with suppress(ProcessLookupError):
            os.kill(victim or sweep.process.pid, signal.SIGKILL)
        if victim and (len(self.done()) > done or has_answered(*workers[victim])):
            sweep.process.kill()  # what the worker was to do is done: the sweep goes on to more
        code, out, err = sweep.end()
        self.sweeps.leave_nothing_running()
        if code != -signal.SIGKILL:
            assert code == 1, err
            assert "SIGKILL" in out + err
        return "worker" if victim else "sweep"

    def _is_at(self, moment: Moment, before: set[tuple[Path, int, int]]) -> bool:
        """Whether the sweep that was started last has come there, or beyond."""
        done, signs = self.done(), self._signs(moment) - before
        return moment.phase_name == "plan" or (
            len(done) >= moment.done and any(file.parent not in done for file, *_ in signs)
        )

    def _signs(self, moment: Moment) -> set[tuple[Path, int, int]]:
        """What phases from this one on have left; who writes it again makes another of it."""
        found = set()
        for pattern, _ in list(PHASES.values())[moment.phase :]:
            for file in self.store.glob(pattern):
                with suppress(FileNotFoundError):
                    stat = file.stat()
                    found.add((file, stat.st_ino, stat.st_mtime_ns))
        return found


def has_answered(request: str, answer: str) -> bool:
    """Return whether a child had answered when it was killed; a read answer's folder is gone."""
    return Path(answer).exists() or not Path(request).exists()


def contents(folder: Path) -> dict[str, tuple[int, ...]]:
    """Inode, time and size of every file, but of a checkpoint that a kill has left."""
    stats = {file: file.stat() for file in folder.rglob("*") if file.name != "checkpoint.npz"}
    return {
        file.relative_to(folder).as_posix(): (stat.st_ino, stat.st_mtime_ns, stat.st_size)
        for file, stat in stats.items()
    }


def results(folder: Path) -> dict[str, Any]:
    """All that a cell gives but where its store is, times and this machine's memory."""
    summary = json.loads((folder / "summary.json").read_text())
    for name in ("training_time_s", "stage_seconds", "render_time_ms", "peak_rss_bytes"):
        del summary[name]
    names = sorted(json.loads((folder / "status.json").read_text())["files"])
    told = {"config.json", "provenance.json", "summary.json"}
    return {"names": names, "summary": summary} | {
        name: (folder / name).read_bytes() for name in names if name not in told
    }


#: A cell's child kills itself soon after its first checkpoint; it needs no Hydra.
KILLED = """
import sys
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    import os, signal, threading, time
    from pathlib import Path

    def kill():
        while not Path("checkpoint.npz").exists():
            time.sleep(0.001)
        imported = sys.modules.keys() & {"hydra", "omegaconf"}
        Path(os.environ["SWEEPS_OF"], "imported").write_text(str(imported or "neither"))
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()
"""


def as_if_spared(folder: CellFolder, home: Path) -> bool:
    """Whether a cell has the results of one that is trained without a break."""
    spared = CellFolder(home / folder.id)
    plan_cell(spared, folder.config(), folder.identity())
    begin_attempt(spared)
    cell.run_cell(folder.config(), folder.variant(), spared)
    return results(folder.path) == results(spared.path)


def test_a_cell_whose_process_is_killed_is_continued_from_its_checkpoint(
    faulty: Callable[[str], Callable[..., tuple[int, str, str]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    sweep = partial(faulty(KILLED), *ARGUMENTS[2:], "baseline=false", "threads=1")
    code, _, err = sweep()
    assert code == 1, err
    assert "SIGKILL" in err
    assert (tmp_path / "imported").read_text() == "neither"
    monkeypatch.setattr(job, "run_in_child", work_here)
    with caplog.at_level(logging.INFO):
        code, _, err = sweep()
    assert code == 0, err
    assert err.count("training cell") == 1
    assert "going on from the checkpoint" in caplog.text
    (folder,) = Store(tmp_path / "s").cell_folders()
    assert as_if_spared(folder, tmp_path)
    for pattern in ("cells/*/.*", "cells/*/checkpoint.npz", "locks/[!.]*"):
        assert not list((tmp_path / "s").glob(pattern))


@pytest.mark.exhaustive
def test_a_sweep_killed_again_and_again_ends_as_if_it_had_not_been(
    sweeps_in: Callable[..., Any],
    smoke_variants: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seed = int(os.environ.get("XRGS_KILL_SEED", random.randrange(10**6)))
    moments = drawn(int(os.environ.get("XRGS_KILLS", "2")), random.Random(seed))
    with capsys.disabled():  # whether the test passes or not
        print(f"\nXRGS_KILLS={len(moments)} XRGS_KILL_SEED={seed}", flush=True)  # noqa: T201
    (tmp_path / "killed").mkdir()
    phases = {moment.phase_name for moment in moments}
    faults = "" if "report" in phases else NO_REPORT
    killed = KilledSweeps(sweeps_in(tmp_path / "killed", faults))
    if "build" not in phases:
        shutil.copytree(smoke_variants, killed.store / "variants")
    for moment in moments:
        start = time.monotonic()
        victim = killed.kill(moment) or killed.kill(replace(moment, later=0))
        _log.info(
            "%d done, %s + %.2f s: %s killed, %.1f s in all",
            *(moment.done, moment.phase_name, moment.later, victim or "nothing"),
            time.monotonic() - start,
        )
        killed.check()
        assert victim

    code, _, err = killed.sweeps.run(*ARGUMENTS)
    assert code == 0, err
    assert err.count("training cell") == CELLS - len(killed.finished)
    killed.check()
    assert len(killed.finished) == CELLS

    assert all(as_if_spared(folder, tmp_path) for folder in map(CellFolder, killed.done()))
    logs = [(done / "log.txt").read_text() for done in killed.done()]
    assert any("going on from the checkpoint" in log for log in logs)
    for pattern in ("cells/*/.*", "cells/*/checkpoint.npz", "locks/[!.]*"):
        assert not list(killed.store.glob(pattern))
