"""Defines every metric: its name, label, unit and direction, in the order of the tables.

To add a metric, add an entry to `METRICS`. A metric that scores a view names its function there,
and every later evaluation computes it; any other is a value of the cell's summary. torch and kornia
are imported where they are used, because plans and reports are made without them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.evaluation.lpips import weights

if TYPE_CHECKING:
    from torch import Tensor

SSIM_WINDOW = 11
"""Width of the SSIM window, px. It is part of the evaluation protocol, and not taken from the
training loss: another window there must not change what the scores mean."""


def psnr(image: Tensor, target: Tensor) -> float:
    """Compute the peak signal-to-noise ratio 10 log10(1 / mean((image - target)²)).

    The mean is taken in float64 over all pixels and channels.

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.

    Returns:
        The ratio in dB; infinity where the images are identical, as in scikit-image (tables show
        no percentage change from or to infinity).

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].

    Example:
        >>> import torch
        >>> round(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.5)), 4)
        6.0206
    """
    _check(image, target)
    error = float((image.double() - target.double()).square().mean())
    return 10 * math.log10(1 / error) if error else math.inf


def ssim(image: Tensor, target: Tensor) -> float:
    """Compute the structural similarity, averaged over channels and pixels.

    It is `kornia.metrics.ssim`: a Gaussian window of 11 x 11 px and sigma 1.5, data range 1,
    borders reflected. gsplat's evaluation gives the same to the fourth digit.

    Source: [wang2004] "Image quality assessment: from error visibility to structural
    similarity".

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.

    Returns:
        A value in -1..1; 1 where the images are identical.

    Raises:
        ValueError: The shapes differ, are not [H, W, 3], or a side is too short to be reflected.
    """
    from kornia import metrics

    _check(image, target)
    height, width = image.shape[:2]
    if min(height, width) <= SSIM_WINDOW // 2:
        raise ValueError(
            f"an image of {width} x {height} px is too small for SSIM: each side must have more "
            f"than {SSIM_WINDOW // 2} px"
        )
    planes, reference = (x.permute(2, 0, 1)[None] for x in (image, target))  # [1, 3, H, W]
    return float(metrics.ssim(planes, reference, window_size=SSIM_WINDOW).mean())


def lpips(image: Tensor, target: Tensor) -> float | None:
    """Compute the perceptual distance LPIPS, version 0.1, with AlexNet (`alex` in gsplat).

    Source: [zhang2018] "The unreasonable effectiveness of deep features as a perceptual
    metric"; see `xrgs.evaluation.lpips.network`.

    Args:
        image: The render, [H, W, 3] in 0..1.
        target: The photograph, [H, W, 3] in 0..1.

    Returns:
        The distance, 0 where the images are identical; None (n/a in the tables) where this machine
        has no weights, or a side of the images is too short for the network.

    Raises:
        ValueError: The shapes differ or are not [H, W, 3].
        WeightsError: This machine's weights are not the published ones.
    """
    _check(image, target)
    published = weights.load_published()
    if published is None:
        return None
    import torch

    from xrgs.evaluation.lpips.network import MIN_SIDE, distance

    if min(image.shape[:2]) < MIN_SIDE:
        return None
    return float(distance(image, target, {k: torch.from_numpy(v) for k, v in published.items()}))


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
    metric of the whole cell."""


METRICS = (
    Metric("training_time_s", "Training time", "s", higher_is_better=False),
    Metric("render_time_ms", "Render time", "ms", higher_is_better=False),
    Metric("gaussians", "Gaussians", "", higher_is_better=False),
    Metric("memory_bytes", "Memory", "bytes", higher_is_better=False),
    Metric("peak_rss_bytes", "Peak RSS", "bytes", higher_is_better=False),
    Metric("lpips", "LPIPS", "", higher_is_better=False, score=lpips),
    Metric("ssim", "SSIM", "", higher_is_better=True, score=ssim),
    Metric("psnr", "PSNR", "dB", higher_is_better=True, score=psnr),
    Metric("evaluations", "Alpha evaluations", "", higher_is_better=False),
)
"""All metrics, in the order of the tables' rows."""

VIEW_METRICS = {metric.name: metric.score for metric in METRICS if metric.score is not None}
"""The functions that evaluation calls for each test view, by metric name."""


def _check(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"image {list(image.shape)} and target {list(target.shape)} must be the same [H, W, 3]"
        )
