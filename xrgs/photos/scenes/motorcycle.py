"""The `motorcycle` stereo pair of Middlebury 2014, which is in scikit-image's wheel (741 x 500 px).

Source: [scharstein2014] "High-resolution stereo datasets with subpixel-accurate ground
truth". The pair is rectified: both cameras have one orientation, and are 193.001 mm apart along x.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.config import SceneConf
from xrgs.photos.scenes.scene import Scene, bundled_photograph, files_digest, label

#: The calibration published with the pair, px at 741 x 500 and mm.
_FOCAL = 994.978
_CY = 254.877
_CX = {"motorcycle_left": 311.193, "motorcycle_right": 342.279}
_BASELINE = {"motorcycle_left": 0.0, "motorcycle_right": 193.001}


class Motorcycle:
    """The stereo pair, whose cameras are known."""

    def names(self, conf: SceneConf, long_side: int) -> list[str]:  # noqa: ARG002
        """Return the names of the left and the right photograph."""
        return list(files())

    def digest(self, conf: SceneConf, long_side: int) -> str:  # noqa: ARG002
        """Hash the photographs and the intrinsics, which SfM gets."""
        calibration = repr([(name, K.tolist()) for name, K in intrinsics().items()])
        return files_digest(files()) + calibration

    def resolve(self, conf: SceneConf, long_side: int, home: Path) -> Scene:  # noqa: ARG002
        """Find the photographs in scikit-image's wheel."""
        return Scene(label(conf), home.name, files(), intrinsics(), viewmats())


def files() -> dict[str, Path]:
    """Find the left and the right photograph in scikit-image's wheel, by name."""
    return {name: bundled_photograph(f"{name}.png") for name in _CX}


def intrinsics() -> dict[str, NDArray[np.float64]]:
    """Return the published intrinsics [3, 3] in px of the files, by name."""
    return {n: np.array([[_FOCAL, 0, cx], [0, _FOCAL, _CY], [0, 0, 1]]) for n, cx in _CX.items()}


def viewmats() -> dict[str, NDArray[np.float64]]:
    """Return the published poses: world to camera [4, 4] by name, in mm.

    The left camera is the origin of the world.
    """
    matrices = {}
    for name, baseline in _BASELINE.items():
        matrix = np.eye(4)
        matrix[0, 3] = -baseline
        matrices[name] = matrix
    return matrices
