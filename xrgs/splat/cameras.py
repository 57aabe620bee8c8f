"""The pinhole camera that Gaussians are projected with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

ORTHONORMAL_TOLERANCE = 1e-3
"""Largest entry of R R^T - I that a viewmat's rotation R may have: float32 exports of SfM err by
1e-6, a matrix with a scale by that scale."""


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
        ValueError: A matrix has the wrong shape or values that are not finite, `viewmat` is not
            rigid, `K` has skew or a focal length that is not above 0, or the image has no pixel.
            The message names the field.
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

    @property
    def position(self) -> Tensor:
        """The camera's centre [3], world units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]  # [3]
