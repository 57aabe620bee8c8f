"""The control of any claim of efficiency: the baseline, growing as many Gaussians as another cell.

The only change is the threshold of growth, `splat.densify.grow_grad2d`, found by training again
with another one as soon as densification has stopped at too many or too few.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from xrgs.errors import XrgsError
from xrgs.training.components.base import Component, Step

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import CountMatchedConf
    from xrgs.splat.gaussians import Gaussians

_T = TypeVar("_T")

_log = logging.getLogger(__name__)

_ATTEMPTS = 10
_POWER = 1.5
"""First guess of how fast counts fall with the threshold, N ~ threshold^-p; then it is measured."""


class CountOff(Exception):  # noqa: N818 - how a run is ended early, not an error
    """Densification ended with a number of Gaussians too far from the one wanted."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.count = count


class CountMatched(Component):
    """Ends a run with `CountOff` once its number of Gaussians is final and not the one wanted."""

    def __init__(self, conf: CountMatchedConf, stop: int) -> None:
        """Of a run whose densification stops at step `stop` of 30,000."""
        self.wanted, self.tolerance, self.stop = conf.gaussians, conf.tolerance, stop

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Look at the number from the step on at which densification has stopped."""
        if step.nominal >= self.stop:
            self.after_training(gaussians)

    def after_training(self, gaussians: Gaussians) -> None:
        """Look at the number.

        Raises:
            CountOff: it is not within `tolerance` of the one wanted.
        """
        if abs(len(gaussians) / self.wanted - 1) > self.tolerance:
            raise CountOff(len(gaussians))


class Search:
    """Finds a threshold that suits: a secant of log counts, kept in its bracket."""

    def __init__(self, start: float, wanted: int) -> None:
        """Nothing is tried yet.

        Args:
            start: The first threshold.
            wanted: Number of Gaussians.
        """
        self.start, self.wanted = start, wanted
        self.tried: list[tuple[float, int]] = []

    def __call__(self, run: Callable[[float], _T]) -> _T:
        """What `run` gives at the threshold that suits it.

        Args:
            run: Trains with a threshold; raises `CountOff` where that gives too many or too few.

        Raises:
            XrgsError: ten thresholds gave other counts; the message lists them.
        """
        while len(self.tried) < _ATTEMPTS:
            threshold = _next(self.tried, self.wanted) if self.tried else self.start
            try:
                return run(threshold)
            except CountOff as off:
                self.tried.append((threshold, off.count))
                _log.info(
                    "threshold %.3g: %d Gaussians, %d wanted", threshold, off.count, self.wanted
                )
        counts = ", ".join(f"{threshold:.3g}: {count}" for threshold, count in self.tried)
        raise XrgsError(
            f"components.count_matched.gaussians={self.wanted}: no threshold gave it within the"
            f" tolerance ({counts})"
        )

    def state_dict(self) -> dict[str, Any]:
        """What was tried, and with that the threshold that is being tried."""
        return {"tried": self.tried}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on behind what `state_dict` told of."""
        self.tried = [(float(threshold), int(count)) for threshold, count in state["tried"]]


def _next(tried: list[tuple[float, int]], wanted: int) -> float:
    """The threshold to try after these (threshold, count)."""
    low = max((t for t, count in tried if count > wanted), default=0.0)
    high = min((t for t, count in tried if count <= wanted), default=math.inf)
    threshold, count = tried[-1]
    power = _POWER
    if len(tried) > 1 and tried[-2][1] != count and min(count, tried[-2][1]) > 0:
        before, count_before = tried[-2]
        slope = -math.log(count / count_before) / math.log(threshold / before)
        power = min(max(slope, 0.5), 5.0)
    guess: float = threshold * (max(count, 1) / wanted) ** (1 / power)
    if low < guess < high:
        return guess
    if 0 < low < high < math.inf:
        return math.sqrt(low * high)
    # Counts are not quite monotone in the threshold: one side of the bracket may have been wrong.
    return guess * 1.1 if count > wanted else guess / 1.1
