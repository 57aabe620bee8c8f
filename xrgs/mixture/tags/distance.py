"""Tags close-ups HR and distant views LR (the paper's Dining Room)."""

from __future__ import annotations

from xrgs.mixture.sampling_rate import Measures


def distance(view: Measures) -> float:
    """Return 1 / depth."""
    return 1 / view.depth
