"""Tags views by the pixel counts of their photographs (the paper's Camera Keychain)."""

from __future__ import annotations

from xrgs.mixture.sampling_rate import Measures


def megapixels(view: Measures) -> float:
    """Return the pixel count of the original photograph."""
    width, height = view.size
    return float(width * height)
