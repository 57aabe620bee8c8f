"""Chooses the size and the steps of a training for a time, from how quickly this machine trains."""

from __future__ import annotations

#: Sizes of the views that are chosen from, px along the longer side, and the fewest steps that are
#: worth it at 504 px, where they are `preset=laptop`'s; at other sizes as many for each pixel.
_SIZES, _AT, _STEPS = (252, 378, 504, 756, 1008), 504, 3000
#: The fewest steps, whatever the time, and the most: those of the paper.
_LEAST, _MOST = 200, 30_000
#: Height over width, and rendered pixels and Gaussians for each pixel, before views are known.
_ASPECT, _UNITS_OF_A_PIXEL = 0.7, 1.5
#: Shares of the time: for training, where it is not known yet how long the cameras take; and of
#: what is left then, beside the scores and the page, which take so many seconds.
_TRAINING, _OF_THE_REST, _ENDING_S = 0.6, 0.95, 15.0


def size_for(seconds: float, unit: float) -> int:
    """Return the longest side of the views, px, for a time that includes finding the cameras.

    Args:
        seconds: The time.
        unit: Seconds a step for each rendered pixel and each Gaussian.
    """
    fitting = [
        size
        for size in _SIZES
        if _STEPS * (size / _AT) ** 2 * _ASPECT * size**2 * _UNITS_OF_A_PIXEL * unit
        <= _TRAINING * seconds
    ]
    return max(fitting, default=_SIZES[0])


def steps_for(seconds: float, of_a_step: float) -> int:
    """Return how many steps fit into what is left of the time, to two digits.

    Args:
        seconds: The time that is left to the end of the command.
        of_a_step: Seconds of a step.
    """
    count = int((_OF_THE_REST * seconds - _ENDING_S) / of_a_step)
    digits: int = 10 ** max(0, len(str(max(count, 0))) - 2)
    return min(_MOST, max(_LEAST, count // digits * digits))
