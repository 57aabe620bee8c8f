"""Shows a running sweep in one line: what is done, how fast it is, how long it will take.

It reads the store's files alone, so that it works with any launcher, here or on other machines: a
cell that has ended has a status file, and a cell in training has a progress file.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from statistics import fmean
from typing import TYPE_CHECKING, Any, Self

from tqdm import tqdm

from xrgs.experiment.cell_folder import CellFolder
from xrgs.runtime import progress
from xrgs.runtime.progress import log_line
from xrgs.safeio.files import list_names
from xrgs.sweep.snapshot import RunningCell, SweepSnapshot

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from xrgs.runtime.progress import Progress
    from xrgs.sweep.plan import PlannedCell

#: Seconds between two snapshots, at least; and the pause in multiples of the time that a snapshot
#: takes, so that a slow store is not kept busy.
_POLL_S, _PAUSE_FACTOR = 1.0, 20
#: What a cell that took as long as was expected weighs beside those of a sweep.
_CERTAIN = 0.2
#: A log gets a line when a cell has ended, and after so many seconds without one.
_LINE_S = 600.0
#: A cell whose progress file has not changed for so many seconds is not running: its process died
#: together with the one that started it.
_SILENT_S = 120.0

#: Inode and modification time of a file, which change when it is written again; None if absent.
_FileStamp = tuple[int, int] | None


class _Slowness:
    """How many times longer the cells of this sweep take than was expected of them."""

    def __init__(self) -> None:
        """Start with a sweep of which no cell has begun."""
        self._begun: dict[str, tuple[float, float]] = {}
        """When each cell was first seen to run, and what was left of it, 0 to 1."""
        self._took, self._expected = 0.0, 0.0
        """Seconds that the cells took that are done, and that they were expected to take."""

    def begin(self, running: RunningCell) -> None:
        """Note a cell that runs; what is known of it already stays."""
        self._begun.setdefault(str(running.cell.cell_id), (time.monotonic(), 1 - running.share))

    def end(self, cell: PlannedCell) -> None:
        """Note a cell that is done; one that was not seen to run tells nothing."""
        begun = self._begun.get(str(cell.cell_id))
        if begun is not None and cell.seconds is not None:
            since, left = begun
            self._took += time.monotonic() - since
            self._expected += left * cell.seconds

    def ratio(self, plan: Sequence[PlannedCell], running: Sequence[RunningCell]) -> float:
        """Return the ratio of both sums over the cells that are done and what is done of others.

        A part of a cell that took as long as was expected is added: the first steps of a cell,
        which has few Gaussians then, say little.

        Args:
            plan: All cells of the sweep.
            running: Those that run now, which have begun.
        """
        took, expected = self._took, self._expected
        for cell in running:
            since, left = self._begun[str(cell.cell.cell_id)]
            if cell.cell.seconds is not None:
                took += time.monotonic() - since
                expected += (cell.share - (1 - left)) * cell.cell.seconds
        known = [cell.seconds for cell in plan if cell.seconds is not None]
        if not expected or not any(known):
            return 1.0
        certain = _CERTAIN * fmean(known)
        return (took + certain) / (expected + certain)


class SweepMonitor:
    """Shows a sweep while a `with` block runs: a bar on a terminal, occasional lines in a log."""

    def __init__(self, cells: Path) -> None:
        """Prepare to show; nothing is shown before `watch` is called.

        Args:
            cells: The folder that the cells' folders are in.
        """
        self._cells = cells
        self._plan: tuple[PlannedCell, ...] = ()
        self._retry = False
        self._before: dict[str, _FileStamp] = {}
        """The status file of each cell when it was planned."""
        self._ended: dict[str, str] = {}
        """States of the cells that have ended since."""
        self._moved: dict[str, tuple[_FileStamp, float]] = {}
        """The progress file of each cell, and when it was first seen like that."""
        self._pace: float | None = None
        self._steps: dict[str, int] = {}
        """The last count of steps of each cell that was seen to train."""
        self._slowness = _Slowness()
        self._at_once = 1
        self._shown, self._shown_at = 0, time.monotonic()
        """Number of ended cells in the last line of a log, and when that was written."""
        self._bar: tqdm[Any] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="xrgs-monitor", daemon=True)

    def watch(self, plan: Sequence[PlannedCell]) -> None:
        """Set the plan to show; called again when it changes.

        Args:
            plan: All cells.
        """
        first = not self._plan
        self._retry = plan[0].conf.retry == "failed"
        self._plan = tuple({cell.cell_id or cell.spec: cell for cell in plan}.values())
        for cell in self._plan:
            name, state = cell.cell_id, cell.state.name
            if name is None or name in self._before:
                continue
            folder = self._folder(name)
            self._before[name] = (
                None if state in {"absent", "planned"} else _stamp(folder.status_file)
            )
            if state not in {"absent", "planned", "running"}:
                # A progress file that a killed attempt left does not mean that the cell runs.
                self._moved[name] = (_stamp(folder.progress), -math.inf)
        if first:
            self._shown = self._take_snapshot(()).ended

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()
        if self._plan:
            snapshot = self.snapshot()
            if snapshot.ended != self._shown:
                log_line(str(snapshot))

    def _folder(self, name: str) -> CellFolder:
        return CellFolder(self._cells / name)

    def snapshot(self) -> SweepSnapshot:
        """Return the states of the cells now."""
        try:
            begun = set(list_names(self._cells))
        except OSError:
            begun = set()
        return self._take_snapshot(begun)

    def _take_snapshot(self, begun: Iterable[str]) -> SweepSnapshot:
        """Return a snapshot; of the cells that have not ended, only begun ones are read."""
        begun, counts = set(begun), {"done": 0, "failed": 0}
        running: list[RunningCell] = []
        elsewhere: list[RunningCell] = []
        waiting = []
        for cell in self._plan:
            state = self._state(cell, begun)
            if state in counts:
                counts[state] += 1
            elif (now := self._progress(cell, begun)) is None:
                waiting.append(cell)
            else:
                in_other_sweep = cell.state.name == "running"
                (elsewhere if in_other_sweep else running).append(self._running(cell, now))
        slowness = self._slowness.ratio(self._plan, running)
        running = [replace(cell, slowness=slowness) for cell in running]
        paces = [cell.pace for cell in running if cell.pace]
        self._pace = fmean(paces) if paces else self._pace
        self._at_once = max(self._at_once, len(running))
        return SweepSnapshot(
            counts["done"],
            counts["failed"],
            tuple(running),
            tuple(elsewhere),
            tuple(waiting),
            self._pace,
            self._at_once,
            slowness,
        )

    def _running(self, cell: PlannedCell, now: Progress) -> RunningCell:
        name = str(cell.cell_id)
        if now.unit == "step":
            self._steps[name] = now.done
        running = RunningCell(cell, now, self._steps.get(name, 0))
        if cell.state.name != "running":
            self._slowness.begin(running)
        return running

    def _state(self, cell: PlannedCell, begun: set[str]) -> str:
        """Return `done`, `failed`, or nothing while the cell is neither."""
        if cell.error is not None:
            return "failed"
        if cell.state.name == "done" or (cell.state.name == "failed" and not self._retry):
            return cell.state.name
        name = cell.cell_id
        if name is None or (name not in begun and name not in self._ended):
            return ""
        if name not in self._ended:
            folder = self._folder(name)
            if (status := _stamp(folder.status_file)) is None or status == self._before[name]:
                return ""
            state = folder.state(verify=False).name
            if state == "unknown":  # it is read again
                return ""
            if state == "done":
                self._slowness.end(cell)
            self._ended[name] = "done" if state == "done" else "failed"
        return self._ended[name]

    def _progress(self, cell: PlannedCell, begun: set[str]) -> Progress | None:
        if cell.cell_id is None or cell.cell_id not in begun:
            return None
        file = self._folder(cell.cell_id).progress
        stamp, known = _stamp(file), self._moved.get(cell.cell_id)
        if stamp is None:
            return None
        if known is None or known[0] != stamp:
            self._moved[cell.cell_id] = known = (stamp, time.monotonic())
        return None if time.monotonic() - known[1] > _SILENT_S else progress.read(file)

    def _watch(self) -> None:
        pause = _POLL_S
        while not self._stop.wait(pause):
            if self._plan:
                start = time.monotonic()
                with suppress(OSError):  # the store is out of reach for now
                    self._show(self.snapshot())
                pause = max(_POLL_S, _PAUSE_FACTOR * (time.monotonic() - start))

    def _show(self, snapshot: SweepSnapshot) -> None:
        if sys.stderr.isatty():
            self._draw(snapshot)
        elif snapshot.ended != self._shown or time.monotonic() - self._shown_at > _LINE_S:
            log_line(str(snapshot))
            self._shown, self._shown_at = snapshot.ended, time.monotonic()

    def _draw(self, snapshot: SweepSnapshot) -> None:
        if self._bar is None:
            style = "{percentage:3.0f}%|{bar:20}| {desc}"
            self._bar = tqdm(None, bar_format=style, leave=False, dynamic_ncols=True, delay=1e-9)
        self._bar.total = snapshot.total
        self._bar.n = snapshot.ended + sum(cell.share for cell in snapshot.running)
        self._bar.set_description_str(str(snapshot))


def _stamp(file: Path) -> _FileStamp:
    """Return what changes when a file is written again; None if there is no file."""
    try:
        status = file.lstat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns
