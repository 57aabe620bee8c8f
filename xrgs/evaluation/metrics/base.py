"""What metrics share: their description, and the comparison inside a mask."""

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
    """The name of its column in the store."""
    label: str
    """The name shown in tables."""
    unit: str
    """`s`, `ms`, `bytes`, `dB`, or empty for a number without a unit."""
    higher_is_better: bool
    score: Callable[[Tensor, Tensor, Tensor | None], float | None] | None = None
    """The function that scores a render and its photograph, both [H, W, 3] in 0..1, inside a mask
    [H, W] bool, True for a pixel that is used, or None; None for a figure of the whole cell."""
    optional: bool = False
    """Whether it applies to some views alone. It is a row only of tables in which a cell has it."""


def inside(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the image and the target without what is outside the mask.

    Both have the colours of the target's nearest used pixels there, so that nothing is compared,
    and what the mask hides is in no window.

    Args:
        image: The render, [H, W, 3].
        target: The photograph, [H, W, 3].
        mask: [H, W] bool, True for a pixel that is used; None uses all.

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
