"""The cameras and textures of the procedural multi-view scene, which is embedded in this package.

Its textures are photographs in scikit-image's wheel, so that nothing is downloaded. A world unit is
about a metre; y points down, and the cameras are near the origin and look along +z. The solids are
in `still_life`, which needs torch; nothing here does.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.capture.scenes.bundled import bundled_photograph

#: The width of the views, px, where `variant.long_side` is 0.
FULL_SIDE = 1008
_FOCAL = 0.9  # image widths
_FOCUS = np.array([0.0, 0.1, 5.5])  # the point that every camera looks at
_START = np.array([0.7, 0.55, 0.5])  # first position, as a fraction of the cameras' box
_HALF_SIZE = np.array([1.1, 0.7, 0.4])  # half the size of the cameras' box

#: By the name of a texture, its file in scikit-image's wheel and the RGB tint it is multiplied by.
TEXTURES: dict[str, tuple[str, tuple[float, float, float]]] = {
    "astronaut": ("astronaut.png", (1, 1, 1)),
    "bark": ("gravel.png", (0.75, 0.5, 0.35)),
    "brick": ("brick.png", (1.0, 0.72, 0.6)),
    "cat": ("chelsea.png", (1, 1, 1)),
    "coffee": ("coffee.png", (1, 1, 1)),
    "coins": ("coins.png", (1.0, 0.9, 0.6)),
    "gravel": ("gravel.png", (1.0, 0.95, 0.85)),
    "leaves": ("grass.png", (0.55, 1.0, 0.4)),
    "moon": ("moon.png", (1.0, 1.0, 1.0)),
    "page": ("page.png", (1.0, 0.97, 0.88)),
    "retina": ("retina.jpg", (1, 1, 1)),
    "rocket": ("rocket.jpg", (1, 1, 1)),
    "stars": ("hubble_deep_field.jpg", (1, 1, 1)),
    "tissue": ("ihc.png", (1, 1, 1)),
}


def camera_size(long_side: int) -> tuple[int, int]:
    """Compute the size of the views.

    Args:
        long_side: Their width, px; 0 for the full size.

    Returns:
        Width and height, px, at 4:3.
    """
    width = long_side or FULL_SIDE
    return width, max(1, round(width * 0.75))


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """Compute the intrinsics of the views.

    Args:
        width: px.
        height: px.

    Returns:
        [3, 3], px.
    """
    f = _FOCAL * width
    return np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])


def viewmats(views: int) -> NDArray[np.float64]:
    """Compute the poses of forward-facing cameras that are spread evenly over a box.

    Positions follow the R3 sequence (Roberts 2018, "The unreasonable effectiveness of quasirandom
    sequences"), which fills the box evenly for any number of views. Its start is chosen so that
    every 8th of the first 24 views lies between others, and none at the box's border.

    Args:
        views: The number of views.

    Returns:
        World-to-camera matrices [views, 4, 4].
    """
    g = 1.2207440846057596  # the positive real root of x⁴ = x + 1
    steps = np.arange(views)[:, None] * np.array([1 / g, 1 / g**2, 1 / g**3])
    positions = (2 * ((_START + steps) % 1) - 1) * _HALF_SIZE
    return np.stack([_look_at(position) for position in positions])


def _look_at(position: NDArray[np.float64]) -> NDArray[np.float64]:
    forward = (_FOCUS - position) / np.linalg.norm(_FOCUS - position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return matrix


def names(views: int) -> list[str]:
    """Name the views.

    Args:
        views: The number of views.

    Returns:
        `view_000`, `view_001`, ...
    """
    return [f"view_{index:03d}" for index in range(views)]


def digest(long_side: int, views: int) -> str:
    """Hash everything that the rendered views depend on: source code, photographs, parameters.

    Args:
        long_side: As for `camera_size`.
        views: The number of views.

    Returns:
        All 64 hexadecimal digits of a SHA-256.
    """
    sha256 = hashlib.sha256(repr((camera_size(long_side), views)).encode())
    here = Path(__file__).parent
    for file in (
        here / "procedural.py",
        here / "still_life.py",
        here / "raycast.py",
        here.parent / "images.py",
    ):
        sha256.update(file.read_bytes())
    for name, _ in TEXTURES.values():
        sha256.update(bundled_photograph(name).read_bytes())
    return sha256.hexdigest()
