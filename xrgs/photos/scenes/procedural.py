"""The cameras and textures of the procedural multi-view scene, which is embedded in this package.

Its textures are photographs in scikit-image's wheel, so that nothing is downloaded. A world unit is
about a metre; y points down, and the cameras are near the origin and look along +z. The solids are
in `still_life`, which needs torch; nothing here does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.config import SceneConf
from xrgs.photos.scenes import rendered
from xrgs.photos.scenes.scene import Scene, bundled_photograph, check_views, label
from xrgs.safeio.hashing import digest, file_digest

#: The width of the views, px, where `variant.long_side` is 0.
FULL_SIDE = 1008
_FOCAL = 0.9  # image widths
_FOCUS = np.array([0.0, 0.1, 5.5])  # the point that every camera looks at
_START = np.array([0.7, 0.55, 0.5])  # first position, as a fraction of the cameras' box
_HALF_SIZE = np.array([1.1, 0.7, 0.4])  # half the size of the cameras' box

#: Name of a texture -> its file in scikit-image's wheel, and the RGB tint that multiplies it.
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


@dataclass(frozen=True)
class ProceduralScene:
    """The embedded scene: its views are rendered once, and their exact cameras are known."""

    code: Callable[[str], str]
    """Returns the digest of the code of a kind of scenes."""

    def names(self, conf: SceneConf, long_side: int) -> list[str]:  # noqa: ARG002
        """Return the names of the views."""
        check_views(conf)
        return names(conf.views)

    def digest(self, conf: SceneConf, long_side: int) -> str:
        """Hash the source code, the textures, and the size and number of the views."""
        check_views(conf)
        textures = [file_digest(bundled_photograph(name)) for name, _ in TEXTURES.values()]
        return digest([camera_size(long_side), conf.views, textures, self.code("procedural")])

    def resolve(self, conf: SceneConf, long_side: int, home: Path) -> Scene:
        """Render the views, unless they are there."""
        exact = dict(zip(names(conf.views), viewmats(conf.views), strict=True))

        def render(folder: Path) -> None:
            from xrgs.photos.scenes import still_life  # imports torch

            size = camera_size(long_side)
            still_life.render_views(folder, TEXTURES, intrinsics(*size), size, exact)

        files = rendered.provide(home, list(exact), render)
        # The intrinsics are known too, but SfM estimates them, as for a real capture.
        return Scene(label(conf), home.name, files, viewmats=exact)


def camera_size(long_side: int) -> tuple[int, int]:
    """Return width and height of the views, px, at 4:3; `long_side` 0 is the full size."""
    width = long_side or FULL_SIDE
    return width, max(1, round(width * 0.75))


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """Return the intrinsics [3, 3] of views of this size, px."""
    f = _FOCAL * width
    return np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])


def viewmats(views: int) -> NDArray[np.float64]:
    """Compute the poses of forward-facing cameras that are spread evenly over a box.

    Positions follow the R3 sequence (Roberts 2018, "The unreasonable effectiveness of quasirandom
    sequences"), which fills the box evenly for any number of views. Its start is chosen so that
    every 8th of the first 24 views lies between others, and none at the box's border.

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
    """Name the views: `view_000`, `view_001`, ..."""
    return [f"view_{index:03d}" for index in range(views)]
