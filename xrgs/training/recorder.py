"""The record of a training run: history, time, memory and amount of work."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from statistics import fmean
from typing import TYPE_CHECKING, Any

from xrgs.runtime.machine import wait_for_gpu
from xrgs.splat.strategy.refinement import Refinement
from xrgs.training.work import StepWork

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    import torch

    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.rendering import Render
    from xrgs.training.checkpoint import State
    from xrgs.training.components import Step, TrainingView

_HISTORY_ROWS = 200
"""Approximate number of rows in a history, for any number of steps."""


@dataclass(frozen=True)
class TrainingResult:
    """The trained Gaussians, and the record of their training."""

    gaussians: Gaussians
    """The trained model."""
    history: list[dict[str, Any]]
    """One row for each recorded step; every row has every column.

    - Of the step itself: `step`, `view`, `loss`, `gaussians` (the number before densification).
    - Totals since the start: `steps_HR`, `steps_LR`, the counts of `Refinement`, and if not 0,
      `skipped_backward` (steps without a backward pass) and `skipped_shN` (steps without an update
      of shN).
    - All other columns are from the components (`Step.log`): the mean over the steps since the
      previous row with a value, or None without a value.
    """
    seconds: float
    """Time of the training steps and of a dense start, without loading data, evaluation and
    checkpoints."""
    memory_bytes: int
    """Peak memory of a training step, bytes (`TrainingMemory`)."""
    evaluations: int
    """Number of alpha evaluations of all forward passes: the work, independent of the machine."""
    work: dict[str, int]
    """Further counts of work: `StepWork.totals`."""
    stage_seconds: dict[str, float]
    """Stage -> its part of `seconds`: `start` if there is a dense start, `forward` (render and
    loss), `backward`, `optimizer`, and `densification` with the rest of the step."""
    grow_grad2d: float
    """`splat.densify.grow_grad2d` of this training, in normalised device units."""
    scores: list[dict[str, Any]] = field(default_factory=list)
    """One row for each evaluation during training: `step` (number of finished steps), `seconds` and
    `evaluations` (of alpha) since the start, `gaussians` (their number), and a column for each
    score."""


class TrainingRecorder:
    """Records the history, time and work of a training run.

    Its clock starts when it is constructed.
    """

    def __init__(self, steps: int, grow_grad2d: float, views: Iterable[TrainingView]) -> None:
        """Start the clock, with an empty history.

        Args:
            steps: Number of steps of the whole run.
            grow_grad2d: The run's threshold of densification, for the result.
            views: All training views, with the cameras of their photographs.
        """
        self.started = self.lap_started = time.perf_counter()
        self.grow_grad2d = grow_grad2d
        self.row_every = max(1, steps // _HISTORY_ROWS)
        self.last_step = steps - 1
        self.counts = Counter({"steps_HR": 0, "steps_LR": 0} | Refinement().counts())
        self.logged: defaultdict[str, list[float]] = defaultdict(list)
        self.history: list[dict[str, Any]] = []
        self.scores: list[dict[str, Any]] = []
        self.evaluations = 0
        self.work = StepWork(views)
        self.stage_seconds: defaultdict[str, float] = defaultdict(float)

    def lap(self, stage: str) -> None:
        """Add the time since the last lap, or since the start, to a stage.

        Args:
            stage: A key of `TrainingResult.stage_seconds`.
        """
        wait_for_gpu()
        now = time.perf_counter()
        self.stage_seconds[stage] += now - self.lap_started
        self.lap_started = now

    def add_start(self, seconds: float) -> None:
        """Add time before the clock was started to the training time, as stage `start`."""
        self.started -= seconds
        self.stage_seconds["start"] += seconds

    def record_skipped(self, part: str) -> None:
        """Count a skipped part of a step; call it before `record_step`.

        Args:
            part: `backward` (with the update) or `shN`; the history's column is `skipped_<part>`.
        """
        self.counts[f"skipped_{part}"] += 1

    def record_step(
        self, step: Step, loss: torch.Tensor, render: Render, gaussians: Gaussians, sh_degree: int
    ) -> None:
        """Record a step after its update and before its densification.

        Args:
            step: The step, with the values that the components logged.
            loss: Scalar, the loss of the step.
            render: The step's render.
            gaussians: The Gaussians that were rendered.
            sh_degree: Highest band of the spherical harmonics that was rendered.
        """
        self.evaluations += render.evaluations
        self.work.add(step, render, gaussians, sh_degree)
        self.counts[f"steps_{step.view.tag}"] += 1
        for name, value in step.log.items():
            self.logged[name].append(value)
        if step.number % self.row_every == 0 or step.number == self.last_step:
            row = {"step": step.number, "view": step.view.name, "loss": loss.item()}
            means = {name: fmean(values) for name, values in self.logged.items()}
            self.history.append(row | {"gaussians": len(gaussians)} | self.counts | means)
            self.logged.clear()

    def record_evaluations(self, evaluations: int) -> None:
        """Count the alpha evaluations of a render other than that of a step."""
        self.evaluations += evaluations

    def record_refinement(self, refinement: Refinement) -> None:
        """Add a step's refinement to the counts of the history, at the end of the step."""
        self.counts.update(refinement.counts())
        self.lap("densification")

    def record_scores(
        self, steps: int, gaussians: int, evaluate: Callable[[], Mapping[str, float | None]]
    ) -> None:
        """Evaluate the Gaussians; the time does not count as training time.

        Args:
            steps: Number of finished steps.
            gaussians: Number of Gaussians.
            evaluate: Returns name -> score.
        """
        start = time.perf_counter()
        row = {
            "step": steps,
            "seconds": start - self.started,
            "evaluations": self.evaluations,
            "gaussians": gaussians,
        }
        self.scores.append(row | dict(evaluate()))
        self.exclude_time(time.perf_counter() - start)

    def exclude_time(self, seconds: float) -> None:
        """Subtract seconds that have just passed from the training time."""
        self.started += seconds
        self.lap_started += seconds

    def state_dict(self) -> State:
        """Return the record and the training time so far."""
        return {
            "seconds": time.perf_counter() - self.started,
            "counts": dict(self.counts),
            "logged": dict(self.logged),
            "history": self.history,
            "scores": self.scores,
            "evaluations": self.evaluations,
            "work": self.work.state_dict(),
            "stage_seconds": dict(self.stage_seconds),
        }

    def load_state_dict(self, state: State) -> None:
        """Continue a run of the same length; the time since `state_dict` does not count."""
        self.lap_started = time.perf_counter()
        self.started = self.lap_started - float(state["seconds"])
        self.counts = Counter(state["counts"])
        self.logged = defaultdict(list, state["logged"])
        self.history = list(state["history"])
        self.scores = list(state["scores"])
        self.evaluations = int(state["evaluations"])
        self.work.load_state_dict(state["work"])
        self.stage_seconds = defaultdict(float, state["stage_seconds"])

    def finish(self, gaussians: Gaussians, memory_bytes: int) -> TrainingResult:
        """Stop the clock and return the result; fill missing columns of the history with None."""
        seconds = time.perf_counter() - self.started
        empty = {name: None for row in self.history for name in row} | dict.fromkeys(self.counts, 0)
        return TrainingResult(
            gaussians,
            [empty | row for row in self.history],
            seconds,
            memory_bytes,
            self.evaluations,
            self.work.totals(),
            dict(self.stage_seconds),
            self.grow_grad2d,
            self.scores,
        )
