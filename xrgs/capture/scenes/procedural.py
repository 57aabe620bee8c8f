"""The embedded multi-view scene, but for its solids: exact cameras, and which photographs it shows.

The textures are photographs that scikit-image carries in its own wheel, so nothing is downloaded.
Lengths are in metres or so; y points down, the cameras stand near the origin and look along +z.
What stands in the scene is in `still_life`, which needs torch; nothing here does.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.capture.scenes.bundled import photograph

#: Rendered at this size where the variant asks for no other.
FULL_SIDE = 1008
_FOCAL = 0.9  # image widths
_FOCUS = np.array([0.0, 0.1, 5.5])  # every camera looks here
_START = np.array([0.7, 0.55, 0.5])  # of the sequence of positions, as a share of the box
_REACH = np.array([1.1, 0.7, 0.4])  # half size of the box the cameras stand in

#: Name in the scene: file in scikit-image's wheel, and the tint of the grey ones.
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
    """Width and height of the views, 4:3; 0 means the full size."""
    width = long_side or FULL_SIDE
    return width, max(1, round(width * 0.75))


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """[3, 3] px."""
    f = _FOCAL * width
    return np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])


def viewmats(views: int) -> NDArray[np.float64]:
    """World-to-camera matrices [views, 4, 4] of cameras spread over a box, forward-facing.

    Positions follow the R3 sequence (Roberts 2018), which fills the box evenly for any number;
    its start puts every 8th view of the first 24 among the others, none at the rim.
    """
    g = 1.2207440846057596  # the real root of x⁴ = x + 1
    steps = np.arange(views)[:, None] * np.array([1 / g, 1 / g**2, 1 / g**3])
    positions = (2 * ((_START + steps) % 1) - 1) * _REACH
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
    """The views' names, in order."""
    return [f"view_{index:03d}" for index in range(views)]


def digest(long_side: int, views: int) -> str:
    """Hash of everything the rendered views depend on: sources, photographs, parameters; hex."""
    total = hashlib.sha256(repr((camera_size(long_side), views)).encode())
    here = Path(__file__).parent
    for file in (
        here / "procedural.py",
        here / "still_life.py",
        here / "raycast.py",
        here.parent / "images.py",
    ):
        total.update(file.read_bytes())
    for name, _ in TEXTURES.values():
        total.update(photograph(name).read_bytes())
    return total.hexdigest()
