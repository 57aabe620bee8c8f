"""The policies that tag training views HR or LR by a property of the photographs: `variant.tags`.

Each scores every view, and the views of the highest scores are HR. A new policy is one module of
this folder, named after the value of the key, and one line in `POLICIES`. The key of a variant has
the code of the policy that it uses, and not the code of the others. `flag` is no policy: it draws
the HR views by `variant.selection`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from xrgs.mixture.tags.distance import Distance
from xrgs.mixture.tags.megapixels import Megapixels
from xrgs.mixture.tags.sampling_rate import SamplingRate

if TYPE_CHECKING:
    from xrgs.mixture.sampling_rate import Measures


class TagPolicy(Protocol):
    """Scores views."""

    needs_depth: bool
    """Whether it needs cameras and points, and so is applied after SfM."""

    def score(self, view: Measures) -> float:
        """Return a number above 0, higher for HR. NaN, where it is not known, makes the view LR."""


POLICIES: dict[str, TagPolicy] = {
    "megapixels": Megapixels(),
    "distance": Distance(),
    "sampling_rate": SamplingRate(),
}
