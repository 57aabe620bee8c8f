"""Every metric: its name, label, unit and direction, in the order of the tables.

To add a score of views, add a file with its function, and an entry to `METRICS`; `xrgs-store
rescore` then computes it for cells that are done. Any other entry is a figure of the cell's
summary. torch and kornia are imported where they are used, because plans and reports are made
without them.
"""

from __future__ import annotations

from xrgs.evaluation.metrics.base import Metric
from xrgs.evaluation.metrics.lpips import lpips
from xrgs.evaluation.metrics.psnr import psnr
from xrgs.evaluation.metrics.ssim import SSIM_WINDOW, ssim

__all__ = ["METRICS", "SSIM_WINDOW", "VIEW_METRICS", "Metric", "lpips", "psnr", "ssim"]

_PSNR = ("evaluation/metrics/psnr.py",)
_SSIM = ("evaluation/metrics/ssim.py",)
_LPIPS = (
    "evaluation/metrics/lpips.py",
    "evaluation/lpips/network.py",
    "evaluation/lpips/weights.py",
)

METRICS = (
    Metric("training_time_s", "Training time", "s", higher_is_better=False),
    Metric("render_time_ms", "Render time", "ms", higher_is_better=False),
    Metric("gaussians", "Gaussians", "", higher_is_better=False),
    Metric("memory_bytes", "Memory", "bytes", higher_is_better=False),
    Metric("peak_rss_bytes", "Peak RSS", "bytes", higher_is_better=False),
    Metric("lpips", "LPIPS", "", higher_is_better=False, score=lpips, sources=_LPIPS),
    Metric("ssim", "SSIM", "", higher_is_better=True, score=ssim, sources=_SSIM),
    Metric("psnr", "PSNR", "dB", higher_is_better=True, score=psnr, sources=_PSNR),
    Metric("evaluations", "Alpha evaluations", "", higher_is_better=False),
)
"""All metrics, in the order of the tables' rows."""

VIEW_METRICS = {metric.name: metric.score for metric in METRICS if metric.score is not None}
"""The functions that evaluation calls for each test view, by metric name."""
