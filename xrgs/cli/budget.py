"""Chooses size and steps of a training for a given time, from this machine's measured speed."""

from __future__ import annotations

#: The longer sides of views to choose from, px. A size is worth it from 3,000 steps on at 504 px
#: (`preset=laptop`); at other sizes in proportion to the number of pixels.
_SIZES, _AT, _STEPS = (252, 378, 504, 756, 1008), 504, 3000
#: The fewest steps, whatever the time, and the most, those of the paper.
_LEAST, _MOST = 200, 30_000
#: Guesses for unknown views: height over width, and rendered pixels plus Gaussians for each pixel.
_ASPECT, _UNITS_OF_A_PIXEL = 0.7, 1.5
#: The share of the whole time for training, before the time for the cameras is known; the share of
#: the remaining time afterwards; and the seconds for scores and page.
_TRAINING, _OF_THE_REST, _ENDING_S = 0.6, 0.95, 15.0


def size_for(seconds: float, unit: float) -> int:
    """Return the longer side of the views, px, for a time that includes finding the cameras.

    Args:
        seconds: The time of the whole command, s.
        unit: Seconds per step for each rendered pixel and each Gaussian.
    """
    fitting = [
        size
        for size in _SIZES
        if _STEPS * (size / _AT) ** 2 * _ASPECT * size**2 * _UNITS_OF_A_PIXEL * unit
        <= _TRAINING * seconds
    ]
    return max(fitting, default=_SIZES[0])


def steps_for(seconds: float, step_s: float) -> int:
    """Return how many steps fit into the remaining time, to two digits.

    Args:
        seconds: The remaining time of the command, s.
        step_s: Seconds per step.
    """
    count = int((_OF_THE_REST * seconds - _ENDING_S) / step_s)
    digits: int = 10 ** max(0, len(str(max(count, 0))) - 2)
    return min(_MOST, max(_LEAST, count // digits * digits))
