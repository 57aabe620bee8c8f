"""Tags views by their sampling rate, which depends on both pixel count and distance."""

from __future__ import annotations

from xrgs.mixture import sampling_rate as rates
from xrgs.mixture.sampling_rate import Measures


def sampling_rate(view: Measures) -> float:
    """Return the sampling rate of the undistorted HR view: focal length over depth."""
    return rates.sampling_rate(view.K, view.depth)
