"""Shows a running sweep in one line: how many cells are done, the speed, and the time left.

The monitor only reads the store's files, so that it works with any launcher, on any machine: a cell
that has ended has a status file, and a cell in training has a progress file.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, Self

from tqdm import tqdm

from xrgs.runtime import progress
from xrgs.runtime.progress import Progress, log_line
from xrgs.runtime.streams import is_terminal
from xrgs.runtime.text import format_duration
from xrgs.safeio.files import list_names
from xrgs.safeio.sanitize import for_line
from xrgs.store.cell_folder import CellFolder
from xrgs.sweep.plan import PlannedCell

#: Least seconds between two snapshots.
_POLL_S = 1.0
#: The pause after a snapshot is at least this many times as long as the snapshot took, so that a
#: slow store is not kept busy.
PAUSE_FACTOR = 20
#: The speed of a cell is judged from this share of its training on: before, it has few Gaussians.
_JUDGED = 0.25
#: A log gets a line when a cell has ended, and at the latest this many seconds after the last line.
_LINE_S = 600.0
#: A cell whose progress file has not changed for this many seconds is not running: its process has
#: died, and so has the process that started it.
_SILENT_S = 120.0

#: Inode and modification time of a file, which change when it is written again; None if absent.
_FileStamp = tuple[int, int] | None


@dataclass(frozen=True)
class RunningCell:
    """A cell in training or evaluation."""

    cell: PlannedCell
    progress: Progress
    """The content of its progress file."""
    share: float
    """The share of its training steps that are done, 0 to 1."""

    @property
    def rate(self) -> float:
        """Recent steps per second; 0 while the cell is not training or just began."""
        return (self.progress.unit == "step" and self.progress.rate) or 0.0


@dataclass(frozen=True)
class SweepSnapshot:
    """The states of a plan's cells at one moment."""

    done: int
    failed: int
    running: tuple[RunningCell, ...]
    elsewhere: tuple[RunningCell, ...]
    """Cells that another sweep is training."""
    waiting: tuple[PlannedCell, ...]
    pace: float | None
    """Mean seconds per step of this sweep's running cells; None before any is known."""
    at_once: int = 1
    """The most cells that this sweep was seen to train at once."""
    slowness: float = 1.0
    """The time that this sweep's cells took, relative to their estimates."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """The share of its steps that each cell had done when it was last seen in training. For a
    moment before it is done a cell has no progress file, and looks as if it waited."""

    @property
    def ended(self) -> int:
        """Number of cells that are done or failed."""
        return self.done + self.failed

    @property
    def total(self) -> int:
        """Number of all cells."""
        return self.ended + len(self.running) + len(self.elsewhere) + len(self.waiting)

    @property
    def left_s(self) -> float | None:
        """Expected seconds left, if as many cells run at once as did so far; None if unknown."""
        waiting = (self.expected_s(cell, self.trained(cell)) for cell in self.waiting)
        ours = [*waiting, *map(self.rest_s, self.running)]
        estimates = [seconds for seconds in ours if seconds is not None]
        if len(estimates) < len(ours):
            return None
        others = [seconds for cell in self.elsewhere if (seconds := self.rest_s(cell))]
        longest = max([*estimates, *others], default=None)
        return longest and max(longest, sum(estimates) / self.at_once)

    @property
    def progress(self) -> float:
        """Number of cells that have ended, with the shares of the others."""
        waiting = (self.shares.get(str(cell.cell_id), 0.0) for cell in self.waiting)
        return self.ended + sum(waiting) + sum(cell.share for cell in self.running)

    def trained(self, cell: PlannedCell) -> float:
        """Return the share of a waiting cell's steps that is done, as far as is known."""
        return max(cell.trained, self.shares.get(str(cell.cell_id), 0.0))

    def expected_s(self, cell: PlannedCell, trained: float) -> float | None:
        """Return the expected seconds to the end of a cell of whose training this share is done."""
        if cell.cost is not None:
            return cell.cost.left_s(trained) * self.slowness
        return None if self.pace is None else (1 - trained) * cell.conf.train.steps * self.pace

    def rest_s(self, running: RunningCell) -> float | None:
        """Return the expected seconds to the end of a running cell; None if unknown."""
        cost, by_store = running.cell.cost, self.expected_s(running.cell, running.share)
        by_pace = running.progress.remaining_s if running.progress.unit == "step" else None
        if by_pace is None or by_store is None or cost is None:
            return by_store if by_pace is None else by_pace
        # A cell's own pace misleads at first, when it has few Gaussians, and is right at the end.
        scoring = cost.scoring_s * self.slowness
        return (1 - running.share) * by_store + running.share * (by_pace + scoring)

    def __str__(self) -> str:
        parts = [f"{self.done} of {self.total} cells done"]
        if self.failed:
            parts.append(f"{self.failed} failed")
        if self.elsewhere:
            parts.append(f"{len(self.elsewhere)} in another sweep")
        if len(self.running) > 1:
            parts.append(f"{len(self.running)} in training")
        parts += self._pace_and_rest()
        if len(self.running) == 1:  # last: a narrow terminal cuts it off
            parts.append(f"{for_line(self.running[0].cell.name)}: {self.running[0].progress.count}")
        return ", ".join(parts)

    @property
    def brief(self) -> str:
        """The state of a single training: its count, speed and time left, without cells."""
        counts = [cell.progress.count for cell in self.running] or ["training"]
        return ", ".join([*counts, *self._pace_and_rest()])

    def _pace_and_rest(self) -> list[str]:
        rate = sum(cell.rate for cell in self.running)
        parts = [f"{rate:.3g} steps/s"] if rate else []
        if self.left_s is not None:
            parts.append(f"{format_duration(self.left_s)} left")
        return parts


class _Slowness:
    """Compares the times of this sweep's cells with their estimates."""

    def __init__(self) -> None:
        self._begun: dict[str, tuple[float, float]] = {}
        """When each cell was first seen in training, and the share that was done then."""
        self._ended: list[tuple[float, float]] = []
        """The seconds that each ended cell took, and its estimate of them."""

    def begin(self, running: RunningCell) -> None:
        """Note a cell in training, once."""
        self._begun.setdefault(str(running.cell.cell_id), (time.monotonic(), running.share))

    def end(self, cell: PlannedCell) -> None:
        """Note a cell that is done."""
        self._ended.append(self._times(cell, 1.0, scored=True))

    def ratio(self, running: Sequence[RunningCell]) -> float:
        """Return the time that cells took, relative to their estimates; 1 until it is known."""
        times = [*self._ended, *(self._times(cell.cell, cell.share) for cell in running)]
        took, expected = (sum(seconds) for seconds in zip((0.0, 0.0), *times, strict=True))
        return took / expected if expected else 1.0

    def _times(
        self, cell: PlannedCell, share: float, *, scored: bool = False
    ) -> tuple[float, float]:
        """Return the seconds that a cell took so far, and its estimate; zeros if not judged yet."""
        begun, before = self._begun.get(str(cell.cell_id), (0.0, 1.0))
        if cell.cost is None or share - before < _JUDGED:
            return 0.0, 0.0
        steps = (share - before) * (cell.cost.seconds - cell.cost.scoring_s)
        return time.monotonic() - begun, steps + (cell.cost.scoring_s if scored else 0.0)


class SweepMonitor:
    """Shows a sweep while a `with` block runs: a bar on a terminal, occasional lines in a log."""

    def __init__(self, cells: Path, *, brief: bool = False) -> None:
        """Prepare to show cells of a folder; with `brief`, a single one without its name."""
        self._cells, self._brief = cells, brief
        self._plan: tuple[PlannedCell, ...] = ()
        self._retry = False
        self._before: dict[str, _FileStamp] = {}
        """The status file of each cell when it was planned."""
        self._ended: dict[str, str] = {}
        """States of the cells that have ended since."""
        self._moved: dict[str, tuple[_FileStamp, float]] = {}
        """The stamp of each cell's progress file, and when this stamp was first seen."""
        self._pace: float | None = None
        self._shares: dict[str, float] = {}
        """The share of its steps that each cell has done, when it was last seen in training."""
        self._slowness = _Slowness()
        self._at_once = 1
        self._shown, self._shown_at = 0, time.monotonic()
        """Number of ended cells in the last line of a log, and when that was written."""
        self._bar: tqdm[Any] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="xrgs-monitor", daemon=True)

    def watch(self, plan: Sequence[PlannedCell]) -> None:
        """Set the cells to show; called again when they change."""
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
        snapshot = self.snapshot()
        if snapshot.ended != self._shown and not self._brief:
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
            if state:
                counts[state] += 1
            elif (now := self._progress(cell, begun)) is None:
                waiting.append(cell)
            else:
                in_other_sweep = cell.state.name == "running"
                (elsewhere if in_other_sweep else running).append(self._running(cell, now))
        paces = [1 / cell.rate for cell in running if cell.rate]
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
            self._slowness.ratio(running),
            dict(self._shares),
        )

    def _running(self, cell: PlannedCell, now: Progress) -> RunningCell:
        name = str(cell.cell_id)
        if now.unit == "step" and now.total:
            self._shares[name] = min(1.0, now.done / now.total)
        running = RunningCell(cell, now, self._shares.get(name, 0.0))
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
            state = folder.state(verify=False)
            if state.unreadable:  # it is read again
                return ""
            if state.name == "done":
                self._slowness.end(cell)
            self._ended[name] = "done" if state.name == "done" else "failed"
        return self._ended[name]

    def _progress(self, cell: PlannedCell, begun: set[str]) -> Progress | None:
        if cell.cell_id is None or cell.cell_id not in begun:
            return None
        file = self._folder(cell.cell_id).progress
        stamp, seen = _stamp(file), self._moved.get(cell.cell_id)
        if stamp is None:
            return None
        if seen is None or seen[0] != stamp:
            self._moved[cell.cell_id] = seen = (stamp, time.monotonic())
        return None if time.monotonic() - seen[1] > _SILENT_S else progress.read(file)

    def _watch(self) -> None:
        pause = _POLL_S
        while not self._stop.wait(pause):
            if self._plan:
                start = time.monotonic()
                with suppress(OSError):  # the store is out of reach for now
                    self._show(self.snapshot())
                pause = max(_POLL_S, PAUSE_FACTOR * (time.monotonic() - start))

    def _show(self, snapshot: SweepSnapshot) -> None:
        if is_terminal(sys.stderr):
            self._draw(snapshot)
        elif (
            snapshot.ended != self._shown and not self._brief
        ) or time.monotonic() - self._shown_at > _LINE_S:
            log_line(self._text(snapshot))
            self._shown, self._shown_at = snapshot.ended, time.monotonic()

    def _draw(self, snapshot: SweepSnapshot) -> None:
        if self._bar is None:
            style = "{percentage:3.0f}%|{bar:20}| {desc}"
            self._bar = tqdm(None, bar_format=style, leave=False, dynamic_ncols=True, delay=1e-9)
        # Where a training starts again, as with count_matched, the bar stays where it was.
        shown = self._bar.n if self._bar.total == snapshot.total else 0
        self._bar.total, self._bar.n = snapshot.total, max(shown, snapshot.progress)
        self._bar.set_description_str(self._text(snapshot))

    def _text(self, snapshot: SweepSnapshot) -> str:
        return snapshot.brief if self._brief else str(snapshot)


def _stamp(file: Path) -> _FileStamp:
    """Return a stamp that changes when a file is written again; None if there is no file."""
    try:
        status = file.lstat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns
