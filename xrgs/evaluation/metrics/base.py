"""What metrics share: their description, and the check of their arguments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
    score: Callable[[Tensor, Tensor], float | None] | None = None
    """The function that scores a render and its photograph, both [H, W, 3] in 0..1; None for a
    figure of the whole cell."""
    sources: tuple[str, ...] = ()
    """The source files of a score, relative to the package: a change in them makes scores stale."""


def check_pair(image: Tensor, target: Tensor) -> None:
    """Raise ValueError unless both images are [H, W, 3] of one size."""
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"image {list(image.shape)} and target {list(target.shape)} must be the same [H, W, 3]"
        )
