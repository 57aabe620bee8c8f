"""The policies that tag training views HR or LR by a property of the photographs: `variant.tags`.

A policy scores every view, and the views with the highest scores are HR. To add one, add a module
to this folder, named after the value of the config's key, and a line to `POLICIES`. A variant's key
includes only the code of its own policy. The value `flag` has no policy: it selects HR views by
`variant.selection`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from xrgs.mixture.sampling_rate import Measures
from xrgs.mixture.tags.distance import distance
from xrgs.mixture.tags.megapixels import megapixels
from xrgs.mixture.tags.sampling_rate import sampling_rate


class TagPolicy(NamedTuple):
    """A way to score views."""

    score: Callable[[Measures], float]
    """Function of a view: a number above 0, higher for HR; NaN (unknown) makes the view LR."""
    needs_depth: bool = True
    """Whether it needs cameras and points, and so is applied after SfM."""


POLICIES: dict[str, TagPolicy] = {
    "megapixels": TagPolicy(megapixels, needs_depth=False),
    "distance": TagPolicy(distance),
    "sampling_rate": TagPolicy(sampling_rate),
}
