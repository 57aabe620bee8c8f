"""A sweep while it runs, in one line: what is done, how fast it goes, how long it will take.

It rests on the store's files alone, so that it is the same whatever launches the cells, here or on
other machines: a cell that is over has a status, one that is being trained has its progress.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any, Self

from tqdm import tqdm

from xrgs.experiment.store import CellFolder
from xrgs.runtime import progress
from xrgs.runtime.progress import duration, say

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from xrgs.runtime.progress import Progress
    from xrgs.sweep.plan import Planned

#: Seconds between looks; of the time, looking takes no more than one part in so many, however slow
#: the store is.
_LOOK_S, _PART = 1.0, 20
#: A log has a line when a cell is over, and after so many seconds without.
_LINE_S = 600.0
#: Whose progress stood still for so long is not running: its process died with who started it.
_SILENT_S = 120.0

_Mark = tuple[int, int] | None


@dataclass(frozen=True)
class Running:
    """A cell whose process is at work."""

    cell: Planned
    now: Progress

    @property
    def share(self) -> float:
        """How much of its training is done, 0..1."""
        if self.now.unit != "step":
            return float(self.now.what == "evaluating")
        return self.now.done / self.now.total if self.now.total else 0.0

    @property
    def pace(self) -> float | None:
        """Seconds a step, lately."""
        return 1 / self.now.rate if self.now.unit == "step" and self.now.rate else None

    @property
    def left_s(self) -> float | None:
        """Seconds left.

        Its pace tells little at first, when its Gaussians are few; what past cells took tells less
        the nearer the end is. Each counts by how far it is.
        """
        past = None if self.cell.seconds is None else (1 - self.share) * self.cell.seconds
        own = self.now.left_s
        if past is None or own is None:
            return own if past is None else past
        return (1 - self.share) * past + self.share * own


@dataclass(frozen=True)
class SweepSnapshot:
    """Where the cells of a plan stand at one moment."""

    done: int
    failed: int
    running: tuple[Running, ...]
    elsewhere: tuple[Running, ...]
    """In training by another sweep."""
    waiting: tuple[Planned, ...]
    pace: float | None
    """Seconds a step of the cells of this sweep, as far as they are known."""

    @property
    def over(self) -> int:
        """Cells that nothing more is done for."""
        return self.done + self.failed

    @property
    def total(self) -> int:
        """All of them."""
        return self.over + len(self.running) + len(self.elsewhere) + len(self.waiting)

    @property
    def left_s(self) -> float | None:
        """Seconds of training left, if as many cells at once go on being trained as are now."""
        waiting = [self._expected(cell) for cell in self.waiting]
        running = [cell.left_s for cell in self.running]
        others = [cell.left_s for cell in self.elsewhere]
        known = [seconds for seconds in (*waiting, *running) if seconds is not None]
        if len(known) < len(waiting) + len(running):
            return None
        longest = max((s for s in (*known, *others) if s is not None), default=None)
        return longest and max(longest, sum(known) / max(1, len(running)))

    def _expected(self, cell: Planned) -> float | None:
        if cell.seconds is not None:
            return cell.seconds
        return None if self.pace is None else cell.conf.train.steps * self.pace

    def __str__(self) -> str:
        parts = [f"{self.done} of {self.total} cells done"]
        if self.failed:
            parts.append(f"{self.failed} failed")
        if self.elsewhere:
            parts.append(f"{len(self.elsewhere)} in another sweep")
        if len(self.running) == 1:
            parts.append(self.running[0].now.count)
        elif self.running:
            parts.append(f"{len(self.running)} in training")
        if rate := sum(1 / run.pace for run in self.running if run.pace):
            parts.append(f"{rate:.3g} steps/s")
        if self.left_s is not None:
            parts.append(f"{duration(self.left_s)} left")
        return ", ".join(parts)


class View:
    """Shows a sweep as long as `with` lasts: a bar on a terminal, in a log a line now and then."""

    def __init__(self, cells: Path) -> None:
        """Nothing is shown before `watch`.

        Args:
            cells: the folder that their folders are in.
        """
        self._cells = cells
        self._plan: tuple[Planned, ...] = ()
        self._retry = False
        self._before: dict[str, _Mark] = {}
        """Which status a cell had that this sweep was to train."""
        self._over: dict[str, str] = {}
        """States of the cells that it has seen ending."""
        self._moved: dict[str, tuple[_Mark, float]] = {}
        self._pace: float | None = None
        self._told, self._told_at = 0, time.monotonic()
        self._bar: tqdm[Any] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="xrgs-live", daemon=True)

    def watch(self, plan: Sequence[Planned]) -> None:
        """Take this as what is to be done; called again when it changes."""
        first = not self._plan
        self._retry = plan[0].conf.retry == "failed"
        self._plan = tuple({cell.cell_id or cell.wish: cell for cell in plan}.values())
        for cell in self._plan:
            name, state = cell.cell_id, cell.state.name
            if name is None or name in self._before:
                continue
            folder = self._folder(name)
            self._before[name] = None if state == "absent" else _mark(folder.status)
            if state not in {"absent", "running"}:  # what a killed try left is no sign of life
                self._moved[name] = (_mark(folder.progress), -math.inf)
        if first:
            self._told = self._look(()).over

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()
        if self._plan:
            look = self.look()
            if look.over != self._told:
                say(str(look))

    def _folder(self, name: str) -> CellFolder:
        return CellFolder(self._cells / name)

    def look(self) -> SweepSnapshot:
        """Where the cells stand now."""
        try:
            with os.scandir(self._cells) as entries:
                begun = {entry.name for entry in entries}
        except OSError:
            begun = set()
        return self._look(begun)

    def _look(self, begun: Iterable[str]) -> SweepSnapshot:
        """Of the cells that are not over, only those are looked at that have a folder."""
        begun, counts = set(begun), {"done": 0, "failed": 0}
        running: list[Running] = []
        elsewhere: list[Running] = []
        waiting = []
        for cell in self._plan:
            state = self._state(cell, begun)
            if state in counts:
                counts[state] += 1
            elif (now := self._progress(cell, begun)) is None:
                waiting.append(cell)
            else:
                others = cell.state.name == "running"
                (elsewhere if others else running).append(Running(cell, now))
        paces = [run.pace for run in running if run.pace]
        self._pace = fmean(paces) if paces else self._pace
        return SweepSnapshot(
            counts["done"],
            counts["failed"],
            tuple(running),
            tuple(elsewhere),
            tuple(waiting),
            self._pace,
        )

    def _state(self, cell: Planned, begun: set[str]) -> str:
        """`done`, `failed`, or empty while it is neither."""
        if cell.error is not None:
            return "failed"
        if cell.state.name == "done" or (cell.state.name == "failed" and not self._retry):
            return cell.state.name
        name = cell.cell_id
        if name is None or name not in begun:
            return ""
        if name not in self._over:
            folder = self._folder(name)
            if (now := _mark(folder.status)) is None or now == self._before[name]:
                return ""
            self._over[name] = "done" if folder.state(verify=False).name == "done" else "failed"
        return self._over[name]

    def _progress(self, cell: Planned, begun: set[str]) -> Progress | None:
        if cell.cell_id is None or cell.cell_id not in begun:
            return None
        file = self._folder(cell.cell_id).progress
        mark, known = _mark(file), self._moved.get(cell.cell_id)
        if mark is None:
            return None
        if known is None or known[0] != mark:
            self._moved[cell.cell_id] = known = (mark, time.monotonic())
        return None if time.monotonic() - known[1] > _SILENT_S else progress.read(file)

    def _watch(self) -> None:
        pause = _LOOK_S
        while not self._stop.wait(pause):
            if self._plan:
                start = time.monotonic()
                with suppress(OSError):  # the store is out of reach for now
                    self._show(self.look())
                pause = max(_LOOK_S, _PART * (time.monotonic() - start))

    def _show(self, look: SweepSnapshot) -> None:
        if sys.stderr.isatty():
            self._draw(look)
        elif look.over != self._told or time.monotonic() - self._told_at > _LINE_S:
            say(str(look))
            self._told, self._told_at = look.over, time.monotonic()

    def _draw(self, look: SweepSnapshot) -> None:
        if self._bar is None:
            style = "{percentage:3.0f}%|{bar:20}| {desc}"
            self._bar = tqdm(None, bar_format=style, leave=False, dynamic_ncols=True, delay=1e-9)
        self._bar.total = look.total
        self._bar.n = look.over + sum(run.share for run in look.running)
        self._bar.set_description_str(str(look))


def _mark(file: os.PathLike[str]) -> _Mark:
    """What changes when a file is written anew; None where there is none."""
    try:
        found = os.stat(file)  # noqa: PTH116  of thousands of files a look
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns
