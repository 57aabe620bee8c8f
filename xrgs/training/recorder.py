"""The record of a training run: history, time, memory and amount of work."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from statistics import fmean
from typing import TYPE_CHECKING, Any

from xrgs.runtime.machine import wait_for_gpu
from xrgs.splat.sh import bases
from xrgs.splat.strategy.base import Refinement

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
    """Further counts of work, all but `views` summed over the steps:

    - `views`: number of views that were trained on,
    - `gaussians`, `gaussians_visible`,
    - `pixels` of the renders, `pixels_photograph` of the photographs, and `pixels_left_out`, the
      pixels that smaller renders saved,
    - `pairs` of a pixel and a Gaussian, `pairs_visible` of a pixel and a visible Gaussian,
      `pairs_in_tiles` (`Render.tile_evaluations`),
    - `sh_coefficients` of visible Gaussians, and `sh_coefficients_left_out` of bands that were not
      on.
    """
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

    def __init__(
        self,
        steps: int,
        grow_grad2d: float,
        views: Iterable[TrainingView],
        start_seconds: float = 0.0,
    ) -> None:
        """Start the clock of a run of `steps` steps, with an empty history.

        `start_seconds` is the time of a dense start, which is part of the training time.
        """
        self.lap_started = time.perf_counter()
        self.started = self.lap_started - start_seconds
        self.grow_grad2d = grow_grad2d
        self.row_every = max(1, steps // _HISTORY_ROWS)
        self.last_step = steps - 1
        self.counts = Counter({"steps_HR": 0, "steps_LR": 0} | Refinement().counts())
        self.logged: defaultdict[str, list[float]] = defaultdict(list)
        self.history: list[dict[str, Any]] = []
        self.scores: list[dict[str, Any]] = []
        self.evaluations = 0
        self.work: Counter[str] = Counter()
        self.photographs = {v.name: v.camera.width * v.camera.height for v in views}
        """View name -> number of pixels of its photograph."""
        self.trained: set[str] = set()
        """Names of the views that were trained on."""
        self.stage_seconds = defaultdict(float, {"start": start_seconds} if start_seconds else {})

    def lap(self, stage: str) -> None:
        """Add the time since the last lap, or since the start, to a stage."""
        wait_for_gpu()
        now = time.perf_counter()
        self.stage_seconds[stage] += now - self.lap_started
        self.lap_started = now

    def record_skipped(self, part: str) -> None:
        """Count a skipped `backward` or `shN` of a step; call it before `record_step`."""
        self.counts[f"skipped_{part}"] += 1

    def record_step(
        self, step: Step, loss: torch.Tensor, render: Render, gaussians: Gaussians, sh_degree: int
    ) -> None:
        """Record a step, its render and its scalar loss, after the update.

        `sh_degree` is the highest band of the spherical harmonics that was rendered. The
        densification of the step comes later.
        """
        self.evaluations += render.evaluations
        self._count_work(step, render, gaussians, sh_degree)
        self.counts[f"steps_{step.view.tag}"] += 1
        for name, value in step.log.items():
            self.logged[name].append(value)
        if step.number % self.row_every == 0 or step.number == self.last_step:
            row = {"step": step.number, "view": step.view.name, "loss": loss.item()}
            means = {name: fmean(values) for name, values in self.logged.items()}
            self.history.append(row | {"gaussians": len(gaussians)} | self.counts | means)
            self.logged.clear()

    def _count_work(self, step: Step, render: Render, gaussians: Gaussians, sh_degree: int) -> None:
        visible, pixels = int(render.visible.count_nonzero()), render.alpha.numel()
        photograph = self.photographs[step.view.name]
        stored = gaussians.shN.shape[1] + 1
        self.trained.add(step.view.name)
        self.work.update(
            gaussians=len(gaussians),
            gaussians_visible=visible,
            pixels=pixels,
            pixels_photograph=photograph,
            pixels_left_out=max(0, photograph - pixels),
            pairs=len(gaussians) * pixels,
            pairs_visible=visible * pixels,
            pairs_in_tiles=render.tile_evaluations,
            sh_coefficients=visible * stored,
            sh_coefficients_left_out=visible * (stored - bases(sh_degree)),
        )

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
        """Record the scores of `evaluate`, whose time does not count, after `steps` steps."""
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
            "work": {"counts": dict(self.work), "views": sorted(self.trained)},
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
        self.work = Counter(state["work"]["counts"])
        self.trained = set(state["work"]["views"])
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
            {"views": len(self.trained)} | dict(self.work),
            dict(self.stage_seconds),
            self.grow_grad2d,
            self.scores,
        )
