"""Lists of a variant's views, for tests of what reads them."""

from __future__ import annotations

import numpy as np

from xrgs.capture.frozen import Manifest, ViewEntry


def one_view() -> Manifest:
    """Return the list of a variant with one training view."""
    identities = np.eye(3).tolist(), np.eye(4).tolist()
    return Manifest(
        "k", "s", 5, True, (ViewEntry("a", "train", "", "HR", 9, 9, *identities, 1),), {}
    )
