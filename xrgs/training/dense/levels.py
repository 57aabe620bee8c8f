"""The training views at the coarse and fine resolutions of the plane sweep."""

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
"""Least ratio of the largest view's longer side to that of the coarse level; our choice."""
_FINER = 1.5
"""Least ratio of a view's fine level to its coarse level; otherwise it has no fine level."""


@dataclass(frozen=True)
class Level:
    """A view at one resolution.

    Geometry is computed in float64 without matrix products, since the order in which these add
    depends on the processor.
    """

    gray: Floats
    """[h, w] mean of the photograph's channels, in 0..1."""
    used: Bools
    """[h, w] whether the pixel is inside the view's mask."""
    rotation: Doubles
    """[3, 3] world to camera."""
    offset: Doubles
    """[3] translation from world to camera, world units."""
    focal: Doubles
    """[2] fx, fy, px."""
    centre: Doubles
    """[2] cx, cy, px."""

    @property
    def position(self) -> Doubles:
        """The camera's centre [3], world units."""
        position: Doubles = -(self.rotation * self.offset[:, None]).sum(axis=0)
        return position

    def rays(self) -> tuple[Doubles, Doubles]:
        """Return the pixels' rays: x [1, w] and y [h, 1] at depth 1, camera coordinates."""
        height, width = self.gray.shape
        x = (np.arange(width) + 0.5 - self.centre[0]) / self.focal[0]
        y = (np.arange(height) + 0.5 - self.centre[1]) / self.focal[1]
        return x[None, :], y[:, None]

    def towards(self, other: Level) -> tuple[tuple[Doubles, Doubles, Doubles], Doubles]:
        """Return the coefficients that project this view's pixels into another view.

        Returns:
            a, three arrays [h, w], and b [3]. A pixel of this view at inverse depth q projects to
            (a_0 + b_0 q, a_1 + b_1 q) / (a_2 + b_2 q), px of the other view. Its depth there is
            (a_2 + b_2 q) / q.
        """
        turn = (other.rotation[:, None, :] * self.rotation[None, :, :]).sum(axis=2)  # [3, 3]
        shift = other.offset - (turn * self.offset).sum(axis=1)
        x, y = self.rays()
        a_x, a_y, a_z = (row[0] * x + row[1] * y + row[2] for row in turn)
        (fx, fy), (cx, cy) = other.focal, other.centre
        b = np.array([fx * shift[0] + cx * shift[2], fy * shift[1] + cy * shift[2], shift[2]])
        return (fx * a_x + cx * a_z, fy * a_y + cy * a_z, a_z), b

    def to_world(self, x: Doubles, y: Doubles, depth: Doubles) -> Doubles:
        """Return the points [P, 3] at depth [P] behind the pixels x [P], y [P], world units."""
        rays = (x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1], 1.0
        local = [ray * depth - shift for ray, shift in zip(rays, self.offset, strict=True)]
        turn = self.rotation
        return np.stack([sum(turn[i, k] * local[i] for i in range(3)) for k in range(3)], axis=-1)

    def project(self, points: Doubles) -> tuple[Doubles, Doubles, Doubles]:
        """Project points [P, 3] to x, y (px) and depth, [P] each; nan behind the camera."""
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
    """A training view with its coarse and fine levels."""

    photograph: TrainingView
    coarse: Level
    fine: Level | None
    """None if the view is hardly larger than its coarse level."""

    @property
    def finest(self) -> Level:
        """The level of the view's final depths."""
        return self.coarse if self.fine is None else self.fine


def swept_views(views: tuple[TrainingView, ...], backend: str) -> list[SweptView]:
    """Resample every view to its levels.

    The coarse levels of all views have the same longer side: that of the smallest view, but at most
    a quarter of that of the largest view. A sufficiently larger view also has a fine level, of half
    its size. `backend`, `torch` or `native`, resamples.
    """
    sides = [max(view.camera.width, view.camera.height) for view in views]
    coarse = min(*sides, max(max(sides) // LEAST_SHRINK, 1))
    return [
        SweptView(
            view,
            _level(view, coarse / side, backend),
            _level(view, side // 2 / side, backend) if side // 2 >= _FINER * coarse else None,
        )
        for view, side in zip(views, sides, strict=True)
    ]


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
        np.ones((height, width), bool)
        if view.mask is None
        else resized(view.mask.numpy(), height, width),
        rotation,
        offset,
        stretch * K[[0, 1], [0, 1]],
        stretch * K[:2, 2],
    )


def resized(mask: Bools, height: int, width: int) -> Bools:
    """Return a mask [h, w] at the size [height, width], of the nearest pixels."""
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(np.int64)
        for old, new in zip(mask.shape, (height, width), strict=True)
    )
    result: Bools = mask[rows[:, None], columns]
    return result
