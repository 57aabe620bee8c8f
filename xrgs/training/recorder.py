"""What a training run is measured by: its history, time, memory and amount of work."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from statistics import fmean
from typing import TYPE_CHECKING, Any

from xrgs.splat.refinement import Refinement

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import torch

    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.rasterize import Render
    from xrgs.training.checkpoint import State
    from xrgs.training.components import Step

_HISTORY_ROWS = 200
"""A history has about as many rows, whatever the number of steps."""


@dataclass(frozen=True)
class TrainingResult:
    """The Gaussians that training gave, and what training took."""

    gaussians: Gaussians
    """The trained model."""
    history: list[dict[str, Any]]
    """One row for each recorded step. `step`, `view`, `loss` and `gaussians` (their number before
    the step's densification) are those of the step itself. `steps_HR`, `steps_LR`, the counts of
    `Refinement` and `skipped_backward` (the steps without a backward pass; the column is absent
    where there are none) are totals since the start of training. Every other column is a
    component's log (`Step.log`): its mean over the steps since the row before that logged it, or
    None where none did. Every row has every column."""
    seconds: float
    """Time of the training steps alone: no loading of data, no evaluation, no checkpoints."""
    memory_bytes: int
    """Bytes that training held at the step where they were most (`TrainingMemory`)."""
    evaluations: int
    """Alpha evaluations of all forward passes: the amount of work, independent of the machine."""
    grow_grad2d: float
    """The threshold of densification that the Gaussians were trained with, in normalised device
    units (`splat.densify.grow_grad2d`)."""
    scores: list[dict[str, Any]] = field(default_factory=list)
    """One row for each evaluation during training: `step` (the number of steps done), `seconds` and
    `evaluations` (of alpha, both since the start), `gaussians`, and the scores by their names."""


class TrainingRecorder:
    """Records the history, time and work of a training run.

    Its clock starts when it is constructed.
    """

    def __init__(self, steps: int, grow_grad2d: float) -> None:
        """Start the clock, with an empty history.

        Args:
            steps: Number of steps of the whole run.
            grow_grad2d: The run's threshold of densification, for the result.
        """
        self.started = time.perf_counter()
        self.grow_grad2d = grow_grad2d
        self.row_every = max(1, steps // _HISTORY_ROWS)
        self.last_step = steps - 1
        self.counts = Counter({"steps_HR": 0, "steps_LR": 0} | Refinement().counts())
        self.logged: defaultdict[str, list[float]] = defaultdict(list)
        self.history: list[dict[str, Any]] = []
        self.scores: list[dict[str, Any]] = []
        self.evaluations = 0

    def record_step(
        self,
        step: Step,
        loss: torch.Tensor,
        render: Render,
        gaussians: int,
        *,
        skipped_backward: bool = False,
    ) -> None:
        """Record a step after its update and before its densification.

        Args:
            step: The step, with what the components logged of it.
            loss: Scalar, the loss of the step.
            render: The step's render.
            gaussians: The number of Gaussians.
            skipped_backward: Whether the step had neither a backward pass nor an update.
        """
        self.evaluations += render.evaluations
        self.counts[f"steps_{step.view.tag}"] += 1
        if skipped_backward:
            self.counts["skipped_backward"] += 1
        for name, value in step.log.items():
            self.logged[name].append(value)
        if step.number % self.row_every == 0 or step.number == self.last_step:
            row = {"step": step.number, "view": step.view.name, "loss": loss.item()}
            means = {name: fmean(values) for name, values in self.logged.items()}
            self.history.append(row | {"gaussians": gaussians} | self.counts | means)
            self.logged.clear()

    def record_evaluations(self, evaluations: int) -> None:
        """Count the work of what is rendered beside the steps' own renders.

        Args:
            evaluations: Alpha evaluations of a forward pass.
        """
        self.evaluations += evaluations

    def record_refinement(self, refinement: Refinement) -> None:
        """Add what a step's densification did to the counts of the history.

        Args:
            refinement: The counts of one step; all of them are 0 at most steps.
        """
        self.counts.update(refinement.counts())

    def record_scores(
        self, steps: int, gaussians: int, evaluate: Callable[[], Mapping[str, float | None]]
    ) -> None:
        """Evaluate the Gaussians; the time that it takes is excluded.

        Args:
            steps: Number of steps done.
            gaussians: Number of Gaussians.
            evaluate: Returns the scores by name.
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
        """Exclude from the training time what has just passed with something else.

        Args:
            seconds: Time that was not training.
        """
        self.started += seconds

    def state_dict(self) -> State:
        """Return everything recorded so far, and the seconds of training so far."""
        return {
            "seconds": time.perf_counter() - self.started,
            "counts": dict(self.counts),
            "logged": dict(self.logged),
            "history": self.history,
            "scores": self.scores,
            "evaluations": self.evaluations,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from a state that `state_dict` returned; the time since then is excluded.

        Args:
            state: From a recorder of a run of as many steps.

        Raises:
            KeyError: An entry is missing.
            TypeError: An entry is of another type.
            ValueError: An entry can't be converted to its type.
        """
        self.started = time.perf_counter() - float(state["seconds"])
        self.counts = Counter(state["counts"])
        self.logged = defaultdict(list, state["logged"])
        self.history = list(state["history"])
        self.scores = list(state["scores"])
        self.evaluations = int(state["evaluations"])

    def finish(self, gaussians: Gaussians, memory_bytes: int) -> TrainingResult:
        """Stop the clock and return the result.

        Args:
            gaussians: The trained model.
            memory_bytes: The memory that training held at its peak.

        Returns:
            The result; each row of its history has every column.
        """
        seconds = time.perf_counter() - self.started
        empty = {name: None for row in self.history for name in row} | dict.fromkeys(self.counts, 0)
        return TrainingResult(
            gaussians,
            [empty | row for row in self.history],
            seconds,
            memory_bytes,
            self.evaluations,
            self.grow_grad2d,
            self.scores,
        )
