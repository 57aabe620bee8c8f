"""What a cell is judged by: each metric's name, label, unit and direction, in the tables' order.

To add one: an entry of `METRICS`. A score of a view has its function there, and is then computed by
every evaluation from that on; any other is a number of the cell's summary. torch and kornia are
imported where they are used, since plans and reports are made without them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.evaluation.lpips import weights

if TYPE_CHECKING:
    from torch import Tensor

WINDOW = 11
"""Taps of the SSIM window along each axis."""


def psnr(image: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio `10 log10(1 / mean (image - target)^2)`, the mean in float64.

    Args:
        image: [H, W, 3] in 0..1.
        target: [H, W, 3] in 0..1.

    Returns:
        dB; infinity where the images are identical, as scikit-image has it (a table shows no
        percentage of it).

    Raises:
        ValueError: the shapes differ or aren't [H, W, 3].

    Example:
        >>> import torch
        >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.5)), 4)
        6.0206
    """
    _check(image, target)
    error = float((image.double() - target.double()).square().mean())
    return 10 * math.log10(1 / error) if error else math.inf


def ssim(image: Tensor, target: Tensor) -> float:
    """Structural similarity (Wang et al. 2004), the mean over channels and every pixel.

    kornia's: a Gaussian window of 11 taps and sigma 1.5, data range 1, borders reflected, which is
    what gsplat's evaluation gives to the fourth digit.

    Args:
        image: [H, W, 3] in 0..1.
        target: [H, W, 3] in 0..1.

    Returns:
        -1 to 1; 1 where the images are identical.

    Raises:
        ValueError: the shapes differ, aren't [H, W, 3], or a side is too short to be reflected.
    """
    from kornia import metrics

    _check(image, target)
    height, width = image.shape[:2]
    if min(height, width) <= WINDOW // 2:
        raise ValueError(
            f"an image of {width} x {height} px is too small for SSIM: each side must have more "
            f"than {WINDOW // 2} px"
        )
    planes, reference = (x.permute(2, 0, 1)[None] for x in (image, target))  # [1, 3, H, W]
    return float(metrics.ssim(planes, reference, window_size=WINDOW).mean())


def lpips(image: Tensor, target: Tensor) -> float | None:
    """Perceptual distance (Zhang et al. 2018), AlexNet, version 0.1: gsplat's `alex`.

    Args:
        image: [H, W, 3] in 0..1.
        target: [H, W, 3] in 0..1.

    Returns:
        0 where the images are identical; None (n/a in the tables) where this machine has no
        weights, or a side of the image is too short for the network.

    Raises:
        ValueError: the shapes differ or aren't [H, W, 3].
        WeightsError: the weights that are there aren't the published ones.
    """
    _check(image, target)
    published = weights.published()
    if published is None:
        return None
    import torch

    from xrgs.evaluation.lpips.network import SMALLEST, distance

    if min(image.shape[:2]) < SMALLEST:
        return None
    return float(distance(image, target, {k: torch.from_numpy(v) for k, v in published.items()}))


@dataclass(frozen=True)
class Metric:
    """One row of a table."""

    name: str
    """Column in the store."""
    label: str
    """In tables."""
    unit: str
    """`s`, `bytes`, `dB`, or none."""
    higher_is_better: bool
    score: Callable[[Tensor, Tensor], float | None] | None = None
    """Of a render and its photograph, both [H, W, 3] in 0..1; None: no score of a view."""


METRICS = (
    Metric("training_time_s", "Training time", "s", higher_is_better=False),
    Metric("gaussians", "Gaussians", "", higher_is_better=False),
    Metric("memory_bytes", "Memory", "bytes", higher_is_better=False),
    Metric("peak_rss_bytes", "Peak RSS", "bytes", higher_is_better=False),
    Metric("lpips", "LPIPS", "", higher_is_better=False, score=lpips),
    Metric("ssim", "SSIM", "", higher_is_better=True, score=ssim),
    Metric("psnr", "PSNR", "dB", higher_is_better=True, score=psnr),
    Metric("evaluations", "Alpha evaluations", "", higher_is_better=False),
)
"""The rows of the tables, in order."""

VIEW_METRICS = {metric.name: metric.score for metric in METRICS if metric.score is not None}
"""What evaluation computes for each test view."""


def _check(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"image {list(image.shape)} and target {list(target.shape)} must be the same [H, W, 3]"
        )
