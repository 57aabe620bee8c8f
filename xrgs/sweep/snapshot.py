"""What a sweep's cells are doing at one moment, and how long the rest of the sweep will take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.runtime.progress import format_duration

if TYPE_CHECKING:
    from xrgs.runtime.progress import Progress
    from xrgs.sweep.plan import PlannedCell


@dataclass(frozen=True)
class RunningCell:
    """A cell whose process is training or evaluating it."""

    cell: PlannedCell
    progress: Progress
    """The content of its progress file."""
    steps: int = 0
    """Number of its steps when it was last seen to train."""
    slowness: float = 1.0
    """How many times longer this sweep's cells took than was expected of them."""

    @property
    def share(self) -> float:
        """The share of its training that is done, 0 to 1."""
        if self.progress.unit == "step":
            return self.progress.done / self.progress.total if self.progress.total else 0.0
        if self.progress.what != "evaluating":
            return 0.0
        train = self.cell.conf.train
        if not train.evaluate_every:
            return 1.0
        # Evaluated at a multiple of so many steps, that the last count was before, or at the end.
        evaluated = (self.steps // train.evaluate_every + 1) * train.evaluate_every
        return min(1.0, evaluated / train.steps)

    @property
    def pace(self) -> float | None:
        """Recent seconds per step; None if it is not training, or its rate is not known yet."""
        rate = self.progress.rate
        return 1 / rate if self.progress.unit == "step" and rate else None

    @property
    def left_s(self) -> float | None:
        """Expected seconds to its end; None if unknown.

        Its own pace says little at first, when it has few Gaussians. The times of past cells say
        less and less towards the end. The two are averaged, weighted by the share that is done.
        What comes after its steps is known from past cells alone.
        """
        after = (self.cell.scoring_s or 0.0) * self.slowness
        past, own = self.cell.seconds, self.progress.remaining_s
        if past is not None:
            past = (1 - self.share) * (past * self.slowness - after) + after
        if own is not None and self.progress.unit == "step":
            own += after
        elif self.share < 1:  # of the views that it loads or evaluates amid its steps
            own = None
        if past is None or own is None:
            return own if past is None else past
        return (1 - self.share) * past + self.share * own


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
    """How many times longer this sweep's cells took than was expected of them."""

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
        """Expected seconds left, if as many cells run at once as did so far."""
        waiting = [self._expected(cell) for cell in self.waiting]
        running = [cell.left_s for cell in self.running]
        others = [cell.left_s for cell in self.elsewhere]
        known = [seconds for seconds in (*waiting, *running) if seconds is not None]
        if len(known) < len(waiting) + len(running):
            return None
        longest = max((s for s in (*known, *others) if s is not None), default=None)
        return longest and max(longest, sum(known) / self.at_once)

    def _expected(self, cell: PlannedCell) -> float | None:
        if cell.seconds is not None:
            return cell.seconds * self.slowness
        return None if self.pace is None else cell.conf.train.steps * self.pace

    def __str__(self) -> str:
        parts = [f"{self.done} of {self.total} cells done"]
        if self.failed:
            parts.append(f"{self.failed} failed")
        if self.elsewhere:
            parts.append(f"{len(self.elsewhere)} in another sweep")
        if len(self.running) == 1:
            parts.append(self.running[0].progress.count)
        elif self.running:
            parts.append(f"{len(self.running)} in training")
        if rate := sum(1 / cell.pace for cell in self.running if cell.pace):
            parts.append(f"{rate:.3g} steps/s")
        if self.left_s is not None:
            parts.append(f"{format_duration(self.left_s)} left")
        return ", ".join(parts)
