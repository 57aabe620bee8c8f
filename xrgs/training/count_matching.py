"""Trains the baseline with the number of Gaussians of another cell, to control for that number.

A method that ends with fewer Gaussians has to be better than the baseline with equally few. The
control changes one value of the baseline: `splat.densify.grow_grad2d`, the gradient above which a
Gaussian grows. Training runs with one threshold, ends as soon as densification has stopped at too
many or too few Gaussians, and starts again with another threshold. With `splat.strategy=mcmc` the
number is the budget, and one training is enough. The paper has no such control.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from xrgs.errors import XrgsError
from xrgs.splat.settings import outside_limits
from xrgs.splat.torch_defaults import on_cpu_in_float32
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.components.base import Component, Step
from xrgs.training.loop import train

if TYPE_CHECKING:
    from xrgs.config import Conf
    from xrgs.splat.gaussians import Gaussians
    from xrgs.training.dataset import Dataset
    from xrgs.training.loop import Evaluate
    from xrgs.training.recorder import TrainingResult

_T = TypeVar("_T")

_log = logging.getLogger(__name__)

_ATTEMPTS = 10
_FIRST_POWER = 1.5
"""Assumed p of count ~ threshold^-p until two attempts have measured it."""
_POWER_RANGE = 0.5, 5.0
"""Bounds of the measured p, since counts are noisy and not quite monotone in the threshold."""


@on_cpu_in_float32
def train_cell(
    data: Dataset,
    conf: Conf,
    checkpoint: Checkpoint | None = None,
    evaluate: Evaluate | None = None,
) -> TrainingResult:
    """Train a config: several times if count matching is on, else once.

    With count matching, `splat.densify.grow_grad2d` is the first threshold, and the result's
    `grow_grad2d` the matching one. `splat.strategy=mcmc` has no threshold: the number is its
    budget. The checkpoint includes the search.

    Args:
        data: The training views and the SfM points.
        conf: The config.
        checkpoint: Saves and restores the run; None saves nothing.
        evaluate: As for `xrgs.training.loop.train`.

    Returns:
        The trained Gaussians and the record of their training.

    Raises:
        CheckpointError: The checkpoint does not fit this config and data.
        XrgsError: A component's value is out of range, the components exclude every view, or no
            threshold gives the number of Gaussians.

    Examples:
        >>> result = train(data, compose("+ablation=loss_weighting", "train.steps=5"))
        >>> save_gaussians("trained.ply", result.gaussians)
    """
    count_matched = conf.components.count_matched
    for message in outside_limits(count_matched, "components.count_matched."):
        raise XrgsError(message)
    if count_matched.gaussians == 0:
        return train(data, conf, checkpoint, evaluate=evaluate)
    checkpoint, densify = checkpoint or Checkpoint(), conf.splat.densify
    count_check = CountCheck(count_matched.gaussians, count_matched.tolerance, densify.stop)

    def train_with(**changed: Any) -> TrainingResult:
        splat = replace(conf.splat, densify=replace(densify, **changed))
        return train(data, replace(conf, splat=splat), checkpoint, [count_check], evaluate)

    if conf.splat.strategy == "mcmc":
        try:
            return train_with(budget=count_matched.gaussians / data.view_pixels)
        except CountMismatchError as mismatch:
            raise XrgsError(
                f"components.count_matched.gaussians={count_matched.gaussians}:"
                f" splat.strategy=mcmc ended with {mismatch.count}; it grows by at most 5% every"
                f" splat.densify.every={densify.every} steps, and removes nothing of the first"
                " Gaussians"
            ) from mismatch
    search = ThresholdSearch(densify.grow_grad2d, count_matched.gaussians)
    checkpoint.register(search=search)
    return search.run(lambda threshold: train_with(grow_grad2d=threshold))


class CountMismatchError(Exception):
    """The number of Gaussians after densification, `count`, is outside the tolerance."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.count = count


class CountCheck(Component):
    """Ends a run by CountMismatchError once its number of Gaussians is final and does not match.

    The number may deviate from `target` by a fraction `tolerance` of it. Densification stops at
    step `stop` of a 30,000-step run.
    """

    def __init__(self, target: int, tolerance: float, stop: int) -> None:
        self.target, self.tolerance, self.stop = target, tolerance, stop

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Check the number of Gaussians once densification has stopped."""
        if step.nominal >= self.stop:
            self.after_training(gaussians)

    def after_training(self, gaussians: Gaussians) -> None:
        """Check the number of Gaussians."""
        if abs(len(gaussians) / self.target - 1) > self.tolerance:
            raise CountMismatchError(len(gaussians))


class ThresholdSearch:
    """Searches for the growth threshold that gives a number of Gaussians.

    The method is a secant of log(count) over log(threshold), bracketed by a threshold with too many
    Gaussians and one with too few.

    Attributes:
        tried: (threshold, count) of each failed attempt, in order.
    """

    def __init__(self, start: float, target: int) -> None:
        """Start with no attempts; `start`, in normalised device units, is the first threshold."""
        self.start, self.target = start, target
        self.tried: list[tuple[float, int]] = []

    def run(self, train_at: Callable[[float], _T]) -> _T:
        """Try thresholds until one matches, and return the result of `train_at` for it.

        `train_at` trains with a threshold, and raises `CountMismatchError` if the number of
        Gaussians is outside the tolerance.

        Raises:
            XrgsError: Ten thresholds gave other numbers; the message lists them.
        """
        while len(self.tried) < _ATTEMPTS:
            threshold = next_threshold(self.tried, self.target) if self.tried else self.start
            try:
                return train_at(threshold)
            except CountMismatchError as mismatch:
                self.tried.append((threshold, mismatch.count))
                _log.info(
                    "count matching: threshold %.3g gave %d Gaussians, the target is %d",
                    threshold,
                    mismatch.count,
                    self.target,
                )
        counts = ", ".join(f"{threshold:.3g}: {count}" for threshold, count in self.tried)
        raise XrgsError(
            f"components.count_matched.gaussians={self.target}: no value of"
            " splat.densify.grow_grad2d gave this number within"
            f" components.count_matched.tolerance; tried (value: Gaussians): {counts}"
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the attempts so far, which determine the next threshold."""
        return {"tried": self.tried}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue a search with the same start and target."""
        self.tried = [(float(threshold), int(count)) for threshold, count in state["tried"]]


def next_threshold(tried: Sequence[tuple[float, int]], target: int) -> float:
    """Choose the threshold to try next, after at least one (threshold, count).

    Returns:
        The threshold at which count ~ threshold^-p, fitted to the last two attempts, reaches the
        target. If that is outside the bracket: the bracket's geometric mean, or without a bracket
        a step of 10% from the last threshold.
    """
    low = max((threshold for threshold, count in tried if count > target), default=0.0)
    high = min((threshold for threshold, count in tried if count <= target), default=math.inf)
    threshold, count = tried[-1]
    power = _FIRST_POWER
    if len(tried) > 1 and tried[-2][1] != count and min(count, tried[-2][1]) > 0:
        earlier_threshold, earlier_count = tried[-2]
        slope = -math.log(count / earlier_count) / math.log(threshold / earlier_threshold)
        power = min(max(slope, _POWER_RANGE[0]), _POWER_RANGE[1])
    guess: float = threshold * (max(count, 1) / target) ** (1 / power)
    if low < guess < high:
        return guess
    if 0 < low < high < math.inf:
        return math.sqrt(low * high)
    # Counts are not quite monotone in the threshold, so an end of the bracket may be wrong.
    return guess * 1.1 if count > target else guess / 1.1
