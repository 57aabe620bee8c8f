"""The policies that tag training views HR or LR by a property of the photographs: `variant.tags`.

A policy scores every view, and the views with the highest scores are HR. To add one, add a module
to this folder, named after the value of the config's key, and a line to `POLICIES`. A variant's key
includes only the code of its own policy. The value `flag` has no policy: it selects HR views by
`variant.selection`.
"""

from __future__ import annotations

from typing import Protocol

from xrgs.mixture.sampling_rate import Measures
from xrgs.mixture.tags.distance import Distance
from xrgs.mixture.tags.megapixels import Megapixels
from xrgs.mixture.tags.sampling_rate import SamplingRate


class TagPolicy(Protocol):
    """Scores views."""

    needs_depth: bool
    """Whether the policy needs cameras and points, and so is applied after SfM."""

    def score(self, view: Measures) -> float:
        """Return a number above 0, higher for HR. NaN (unknown) makes the view LR."""


POLICIES: dict[str, TagPolicy] = {
    "megapixels": Megapixels(),
    "distance": Distance(),
    "sampling_rate": SamplingRate(),
}
