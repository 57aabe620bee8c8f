"""All metrics: name, label, unit and direction, in the order of the tables.

To add a score of views, add a file with its function, and an entry to `METRICS`; then `xrgs-store
rescore` computes it for finished cells. The other entries are values of the cell's summary, or
are computed from the PSNR of the views (`xrgs.store.results.over_views`). torch and kornia are
imported inside functions, since plans and reports do not need them.
"""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from xrgs.evaluation.metrics.base import Metric
from xrgs.evaluation.metrics.lpips import lpips, lpips_vgg
from xrgs.evaluation.metrics.psnr import psnr, psnr_plain
from xrgs.evaluation.metrics.psnr_fitted import psnr_fitted
from xrgs.evaluation.metrics.ssim import SSIM_WINDOW, ssim

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

__all__ = [
    "METRICS",
    "ON_REQUEST",
    "SSIM_WINDOW",
    "VIEW_METRICS",
    "Metric",
    "also_scored",
    "lpips",
    "lpips_vgg",
    "psnr",
    "psnr_fitted",
    "psnr_plain",
    "ssim",
]

METRICS = (
    Metric("training_time_s", "Training time", "s", higher_is_better=False),
    Metric("render_time_ms", "Render time", "ms", higher_is_better=False),
    Metric("gaussians", "Gaussians", "", higher_is_better=False),
    Metric("memory_bytes", "Memory", "bytes", higher_is_better=False),
    Metric("peak_rss_bytes", "Peak RSS", "bytes", higher_is_better=False),
    Metric("lpips", "LPIPS", "", higher_is_better=False, score=lpips),
    Metric("ssim", "SSIM", "", higher_is_better=True, score=ssim),
    Metric("psnr", "PSNR", "dB", higher_is_better=True, score=psnr),
    Metric("psnr_pooled", "PSNR (pooled)", "dB", higher_is_better=True),
    Metric("psnr_worst", "PSNR (worst view)", "dB", higher_is_better=True),
    Metric(
        "psnr_plain",
        "PSNR without masks",
        "dB",
        higher_is_better=True,
        score=psnr_plain,
        optional=True,
    ),
    Metric(
        "psnr_fitted",
        "PSNR after a colour fit",
        "dB",
        higher_is_better=True,
        score=psnr_fitted,
        optional=True,
    ),
    Metric(
        "lpips_vgg",
        "LPIPS (VGG)",
        "",
        higher_is_better=False,
        score=lpips_vgg,
        optional=True,
    ),
    Metric("evaluations", "Alpha evaluations", "", higher_is_better=False),
)
"""All metrics, in the order of the tables' rows."""

_SCORES = {metric.name: metric.score for metric in METRICS if metric.score is not None}
ON_REQUEST = frozenset({"lpips_vgg"})
"""Names of scores that are too slow for every evaluation; `xrgs-store rescore --also NAME` computes
them."""

VIEW_METRICS = {name: score for name, score in _SCORES.items() if name not in ON_REQUEST}
"""Metric name -> function that `score_view` calls for each test view."""

_also: ContextVar[frozenset[str]] = ContextVar("also", default=frozenset())


@contextmanager
def also_scored(names: frozenset[str]) -> Iterator[None]:
    """Let `score_view` also compute the scores `names` of `ON_REQUEST`, inside a `with` block.

    An argument would change the code of the evaluation protocol, and so make all scores stale.
    """
    token = _also.set(names)
    try:
        yield
    finally:
        _also.reset(token)


def score_view(
    image: Tensor, target: Tensor, mask: Tensor | None, *, masked: bool
) -> dict[str, float | None]:
    """Score a render against its photograph with every metric of views; arguments as for `psnr`.

    If any view of the evaluation is `masked`, a view without a mask is scored with a mask of all
    pixels, so that every view has the same scores.

    Returns:
        Metric name -> score; None if it can't be computed or does not apply.
    """
    if masked and mask is None:
        import torch

        mask = torch.ones(target.shape[:2], dtype=torch.bool)
    names = [name for name in _SCORES if name in VIEW_METRICS or name in _also.get()]
    return {name: _SCORES[name](image, target, mask) for name in names}
