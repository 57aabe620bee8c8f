"""The training views at the sizes that the plane sweep compares them at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from xrgs.splat.resample import resize

if TYPE_CHECKING:
    from xrgs.training.components import TrainingView

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_SHRINK = 4
"""The coarse level is at least this many times smaller than the largest view, where no view is as
small; our choice."""
_FINER = 1.5
"""A view has a fine level where that is at least this many times as large as the coarse one."""


@dataclass(frozen=True)
class Level:
    """A view at one size.

    Everything is computed product by product in float64, since the order in which the products of
    matrices add depends on the processor.
    """

    gray: Floats
    """[h, w] the mean of the photograph's channels."""
    used: Bools
    """[h, w] the pixels inside the view's mask."""
    rotation: Doubles
    """[3, 3] world to camera."""
    offset: Doubles
    """[3] world to camera, world units."""
    focal: Doubles
    """[2] px: fx, fy."""
    centre: Doubles
    """[2] px: cx, cy."""

    @property
    def position(self) -> Doubles:
        """The camera's centre [3], world units."""
        position: Doubles = -(self.rotation * self.offset[:, None]).sum(axis=0)
        return position

    def rays(self) -> tuple[Doubles, Doubles]:
        """The rays of the pixels: x [1, w] and y [h, 1] at depth 1, camera coordinates."""
        height, width = self.gray.shape
        x = (np.arange(width) + 0.5 - self.centre[0]) / self.focal[0]
        y = (np.arange(height) + 0.5 - self.centre[1]) / self.focal[1]
        return x[None, :], y[:, None]

    def towards(self, other: Level) -> tuple[tuple[Doubles, Doubles, Doubles], Doubles]:
        """How the rays of this view run in another view's image.

        Returns:
            a, three arrays [h, w], and b [3]: a pixel at inverse depth q is at
            (a_0 + b_0 q, a_1 + b_1 q) / (a_2 + b_2 q), px of the other view. The denominator times
            the depth is the depth in the other view.
        """
        turn = (other.rotation[:, None, :] * self.rotation[None, :, :]).sum(axis=2)  # [3, 3]
        shift = other.offset - (turn * self.offset).sum(axis=1)
        x, y = self.rays()
        a_x, a_y, a_z = (row[0] * x + row[1] * y + row[2] for row in turn)
        (fx, fy), (cx, cy) = other.focal, other.centre
        b = np.array([fx * shift[0] + cx * shift[2], fy * shift[1] + cy * shift[2], shift[2]])
        return (fx * a_x + cx * a_z, fy * a_y + cy * a_z, a_z), b

    def to_world(self, x: Doubles, y: Doubles, depth: Doubles) -> Doubles:
        """The points [P, 3] of pixels (x, y) [P] each at a depth [P], world units."""
        rays = (x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1], 1.0
        local = [ray * depth - shift for ray, shift in zip(rays, self.offset, strict=True)]
        turn = self.rotation
        return np.stack([sum(turn[i, k] * local[i] for i in range(3)) for k in range(3)], axis=-1)

    def project(self, points: Doubles) -> tuple[Doubles, Doubles, Doubles]:
        """The pixels x and y and the depths [P] of points [P, 3]; nan behind the camera."""
        turn, shift = self.rotation, self.offset
        x, y, z = (sum(turn[i, k] * points[:, k] for k in range(3)) + shift[i] for i in range(3))
        z = np.where(z > 0, z, np.nan)
        return (
            self.focal[0] * x / z + self.centre[0],
            self.focal[1] * y / z + self.centre[1],
            z,
        )


@dataclass(frozen=True)
class SweptView:
    """A training view, with the levels that it is swept at."""

    photograph: TrainingView
    coarse: Level
    fine: Level | None
    """None where the view is hardly larger than its coarse level."""

    @property
    def finest(self) -> Level:
        """The level that the view's depths have in the end."""
        return self.coarse if self.fine is None else self.fine


def swept_views(views: tuple[TrainingView, ...], backend: str) -> list[SweptView]:
    """Bring every view to its levels.

    The coarse level of all views has one longer side: the smallest of the views', and at most a
    quarter of the largest. A view that is larger has a fine level of half its size.

    Args:
        views: The training views.
        backend: `torch` or `native`: the implementation that resamples.
    """
    sides = [max(view.camera.width, view.camera.height) for view in views]
    coarse = min(*sides, max(max(sides) // LEAST_SHRINK, 1))
    swept = []
    for view, side in zip(views, sides, strict=True):
        fine = side // 2
        has_fine = fine >= _FINER * coarse
        swept.append(
            SweptView(
                view,
                _level(view, coarse / side, backend),
                _level(view, fine / side, backend) if has_fine else None,
            )
        )
    return swept


def _level(view: TrainingView, scale: float, backend: str) -> Level:
    camera = view.camera
    width, height = (max(1, round(scale * size)) for size in (camera.width, camera.height))
    image = view.image
    if (width, height) != (camera.width, camera.height):
        image = resize(image, height, width, backend=backend)
    red, green, blue = image.unbind(-1)
    rotation, offset = (
        part.double().numpy() for part in (camera.viewmat[:3, :3], camera.viewmat[:3, 3])
    )
    stretch = np.array([width / camera.width, height / camera.height])
    K = camera.K.double().numpy()
    return Level(
        ((red + green + blue) / 3).contiguous().numpy(),
        _used(view, height, width),
        rotation,
        offset,
        stretch * K[[0, 1], [0, 1]],
        stretch * K[:2, 2],
    )


def _used(view: TrainingView, height: int, width: int) -> Bools:
    if view.mask is None:
        return np.ones((height, width), bool)
    mask = view.mask.numpy()
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(np.int64)
        for old, new in zip(mask.shape, (height, width), strict=True)
    )
    used: Bools = mask[rows[:, None], columns]
    return used
