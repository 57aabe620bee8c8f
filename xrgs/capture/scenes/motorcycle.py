"""The Middlebury 2014 `motorcycle` stereo pair that scikit-image's wheel carries (741 x 500).

Rectified: both cameras look the same way, and stand 193.001 mm apart along x.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.capture.scenes.bundled import photograph

#: The calibration published with the pair, px at 741 x 500 and mm.
_FOCAL = 994.978
_CY = 254.877
_CX = {"motorcycle_left": 311.193, "motorcycle_right": 342.279}
_BASELINE = {"motorcycle_left": 0.0, "motorcycle_right": 193.001}


def files() -> tuple[Path, ...]:
    """Left and right, in scikit-image's own folder."""
    return tuple(photograph(f"{name}.png") for name in _CX)


def intrinsics() -> dict[str, NDArray[np.float64]]:
    """[3, 3] px at the files' size, by name."""
    return {n: np.array([[_FOCAL, 0, cx], [0, _FOCAL, _CY], [0, 0, 1]]) for n, cx in _CX.items()}


def viewmats() -> dict[str, NDArray[np.float64]]:
    """[4, 4] world to camera by name; the left camera is the world, mm."""
    found = {}
    for name, baseline in _BASELINE.items():
        matrix = np.eye(4)
        matrix[0, 3] = -baseline
        found[name] = matrix
    return found
