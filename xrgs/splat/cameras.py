"""The pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of R R^T - I for the rotation R of a viewmat. SfM exports in float32 have 1e-6; a
matrix with a scale has far more."""
LAST_ROW_TOLERANCE = 1e-5
"""Tolerance of the last row of a viewmat or of K, (0, ..., 0, 1): inverted matrices are rounded."""


class CameraNumbers(NamedTuple):
    """A camera as Python numbers, which the kernels take without a torch operation."""

    viewmat: list[float]
    """The 16 numbers of `Camera.viewmat`, row by row."""
    intrinsics: list[float]
    """fx, fy, cx, cy, px."""
    position: list[float]
    """`Camera.position`, world units."""


@dataclass(frozen=True)
class Camera:
    """An undistorted pinhole camera with OpenCV axes: x right, y down, z forward.

    The centre of the first pixel is at (0.5, 0.5).

    Attributes:
        viewmat: [4, 4] rigid transform from world to camera coordinates.
        K: [3, 3] intrinsics without skew, px.
        width: Width of the image, px.
        height: Height of the image, px.

    Raises:
        ValueError: A matrix has the wrong shape, values that are not finite or a last row other
            than 0, ..., 0, 1; `viewmat` is not rigid; `K` has skew or a focal length of 0 or less;
            or the image has no pixel. The message names the field.

    Examples:
        >>> K = torch.tensor([[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]])
        >>> camera = Camera(viewmat=torch.eye(4), K=K, width=48, height=32)
        >>> camera.resized(96, 64).K[0, 0]
        tensor(80.)
    """

    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3]
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width and height must be at least 1, got {self.width}x{self.height}")
        for name, matrix, size in (("viewmat", self.viewmat, 4), ("K", self.K, 3)):
            if matrix.shape != (size, size):
                raise ValueError(f"{name} must be [{size}, {size}], got {list(matrix.shape)}")
            if not torch.isfinite(matrix).all():
                raise ValueError(f"{name} has values that are not finite")
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError("K must have focal lengths above 0")
        if self.K[0, 1] != 0 or self.K[1, 0] != 0:
            raise ValueError("K must have no skew")
        rotation = self.viewmat[:3, :3]
        error = rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)
        if error.abs().max() > ORTHONORMAL_TOLERANCE or torch.linalg.det(rotation) < 0:
            raise ValueError("viewmat must be a rotation and a translation, without scale")
        for name, matrix in (("viewmat", self.viewmat), ("K", self.K)):
            row = matrix[-1]
            if (row - torch.eye(len(row), dtype=row.dtype)[-1]).abs().max() > LAST_ROW_TOLERANCE:
                raise ValueError(
                    f"the last row of {name} must be 0, ..., 0, 1, got {row.tolist()}; is it"
                    " transposed?"
                )

    @property
    def position(self) -> Tensor:
        """The camera's centre [3], world units."""
        # Not a matrix product: the order in which torch adds depends on the processor.
        first, second, third = (row[:3] * row[3] for row in self.viewmat[:3])
        position: Tensor = -(first + second + third)  # [3]
        return position

    @cached_property
    def numbers(self) -> CameraNumbers:
        """The camera as Python numbers, cached, since training renders each view many times."""
        (fx, _, cx), (_, fy, cy), _ = self.K.tolist()
        viewmat = self.viewmat.flatten().tolist()
        return CameraNumbers(viewmat, [fx, fy, cx, cy], self.position.tolist())

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same view at another image size, px."""
        scale = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])  # [3, 1]
        return Camera(self.viewmat, self.K * scale, width, height)

    def to_camera(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return x, y and z [P] each of points [P, 3] in camera coordinates, world units.

        They have the points' type; z is the depth.
        """
        first, second = (_along(row, points) for row in self.viewmat[:2])
        return first, second, self.depths(points)

    def depths(self, points: Tensor) -> Tensor:
        """Return the depths [P] of points [P, 3] in front of the camera, world units."""
        return _along(self.viewmat[2], points)

    def in_image(
        self, points: Tensor, *, near: float = 0.0, margin: float = 0.0
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Find the points that project into the image.

        Args:
            points: [P, 3] world units, float32 or float64.
            near: Points at this depth or nearer count as outside, world units.
            margin: Fraction of the image's size by which a point may lie outside.

        Returns:
            x, y and z [P] each of `to_camera`, and which points are in the image [P] bool.
        """
        K = self.K.to(points)
        x, y, depth = self.to_camera(points)
        inside = depth > near
        for axis, place, size in ((0, x, self.width), (1, y, self.height)):
            # Pixel times depth: dividing by the depth fails where it is 0.
            pixels = K[axis, axis] * place + K[axis, 2] * depth
            inside &= (pixels >= -margin * size * depth) & (pixels <= (1 + margin) * size * depth)
        return x, y, depth, inside

    @classmethod
    def look_at(
        cls,
        position: Sequence[float],
        target: Sequence[float],
        *,
        width: int,
        height: int,
        fov: float = 50.0,
        up: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> Camera:
        """Return a camera at a position that looks at a target.

        Args:
            position: Centre of the camera: x, y, z in world units.
            target: Point at the centre of the image: x, y, z in world units.
            width: Width of the image, px.
            height: Height of the image, px.
            fov: Horizontal field of view, degrees, above 0 and below 180.
            up: World direction that points up in the image, of any length.

        Returns:
            The camera, float32, with square pixels.

        Raises:
            ValueError: `fov` is out of range, position and target are the same point, or `up` is
                parallel to the line between them.
        """
        if not 0 < fov < 180:
            raise ValueError(f"fov must be above 0 and below 180 degrees, got {fov}")
        start, end, upward = (torch.tensor(v, dtype=torch.float64) for v in (position, target, up))
        forward = end - start
        right = torch.linalg.cross(forward, upward)
        if right.norm() <= 1e-9 * forward.norm() * upward.norm():
            raise ValueError("look_at: up must not be along the line from position to target")
        down = torch.linalg.cross(forward, right)
        rotation = torch.stack([axis / axis.norm() for axis in (right, down, forward)])  # [3, 3]
        viewmat = torch.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ start
        focal = 0.5 * width / math.tan(math.radians(fov) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return cls(viewmat, K, width, height)


def _along(row: Tensor, points: Tensor) -> Tensor:
    """Return a coordinate [P] of points [P, 3], by its row [4] of a world-to-camera matrix."""
    # Written out, as in `Camera.position`.
    (x, y, z), row = points.unbind(-1), row.to(points)
    return row[0] * x + row[1] * y + row[2] * z + row[3]
