"""Tags views by their sampling rate, which depends on both pixel count and distance."""

from __future__ import annotations

from xrgs.mixture.sampling_rate import Measures, sampling_rate


class SamplingRate:
    """The policy `sampling_rate`."""

    needs_depth = True

    def score(self, view: Measures) -> float:
        """Return the sampling rate of the undistorted HR view: focal length over depth."""
        return sampling_rate(view.K, view.depth)
