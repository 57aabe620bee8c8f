"""The description of a metric, and the comparison inside a mask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.photos import masks

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Metric:
    """A metric: one row of a table."""

    name: str
    """Name of the metric's column in the store."""
    label: str
    """Name in tables."""
    unit: str
    """`s`, `ms`, `bytes`, `dB`, or empty for a dimensionless number."""
    higher_is_better: bool
    score: Callable[[Tensor, Tensor, Tensor | None], float | None] | None = None
    """Function of a render and its photograph, both [H, W, 3] in 0..1, and a mask [H, W] bool (True
    for a used pixel) or None, which returns the score. None for a metric of the whole cell."""
    optional: bool = False
    """Whether the metric applies only to some views. Tables show it only if a cell has it."""


def inside(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Replace the pixels of image and target outside the mask by equal colours.

    Both get the colour of the target's nearest used pixel. So pixels outside the mask do not
    differ, and no window of a metric contains the hidden ones. Arguments as for
    `xrgs.evaluation.metrics.psnr.psnr`.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].
    """
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"image {list(image.shape)} and target {list(target.shape)} must be the same [H, W, 3]"
        )
    if mask is None:
        return image, target
    if mask.shape != image.shape[:2]:
        raise ValueError(f"mask {list(mask.shape)} must be {list(image.shape[:2])} [H, W]")
    filled = target.new_tensor(masks.filled(target.numpy(), mask.numpy()))
    return image.where(mask[..., None], filled), filled
