"""The result of rendering one view."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Render:
    """A rendered image, and the work and memory that it took."""

    image: Tensor  # [H, W, 3], 0 and up: not clamped at 1
    alpha: Tensor  # [H, W], 1 - transmittance
    visible: Tensor  # [N] bool
    evaluations: int
    """Number of (pixel, Gaussian) pairs whose alpha was computed."""
    buffer_bytes: int
    """Peak bytes that the renderer allocates beside the parameters and their gradients."""
    tile_evaluations: int
    """`evaluations` if every pixel of a tile met every Gaussian of the tile's list: what the lists
    of tiles alone leave to compute."""
