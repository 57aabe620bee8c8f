"""Lists of a variant's views, for tests of what reads them."""

from __future__ import annotations

import numpy as np

from xrgs.mixture.saved_variant import Manifest, ViewEntry


def one_view() -> Manifest:
    """Return the list of a variant with one training view."""
    view = ViewEntry("a", "train", "", "HR", 9, 9, np.eye(3).tolist(), np.eye(4).tolist(), 1.0)
    return Manifest("k", "s", 5, True, (view,), {})
