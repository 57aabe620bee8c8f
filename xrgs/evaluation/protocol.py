"""The evaluation protocol: scores every test view at its full size, one by one.

Each view is rendered with the settings of the training and all SH bands, and clamped to 0..1. The
float32 image is scored against the 8-bit photograph / 255 with every metric of
`xrgs.evaluation.metrics.VIEW_METRICS`, inside the view's mask.

The weights of LPIPS are a separate download. Only the published weights are accepted, so a cell's
identity does not depend on them: without the weights, a cell is complete but has no LPIPS.
"""

from __future__ import annotations

import time
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

from xrgs.evaluation.metrics import score_view
from xrgs.photos import images
from xrgs.runtime.machine import torch_threads, wait_for_gpu
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from torch import Tensor

    from xrgs.config import SplatConf
    from xrgs.mixture.views import View
    from xrgs.splat.gaussians import Gaussians
    from xrgs.training.dataset import LoadedView


def score_views(
    gaussians: Gaussians, views: Sequence[LoadedView], conf: SplatConf, renders: Path
) -> list[dict[str, Any]]:
    """Render and score each view, and write its clamped render as `<view>.png`.

    The files are not synced to the disk here; `CellFolder.finish` syncs them.

    Args:
        gaussians: The trained model.
        views: The test views, at full size.
        conf: Settings of the model; those of the rasterizer and the backend are read.
        renders: The folder for the renders, created if missing; its parent must exist.

    Returns:
        One row for each view: `view`, its name, and a column for each metric, None if the metric is
        not available.
    """
    renders.mkdir(exist_ok=True)
    gaussians = _placed(gaussians, conf)
    rows, masked = [], _any_mask(views)
    for view in progress(views, "evaluating", "view"):
        image, scores = _score(gaussians, view, conf, masked=masked)
        rows.append({"view": view.name} | scores)
        images.save(renders / f"{view.name}.png", image.numpy(), durable=False)
    return rows


def mean_scores(
    gaussians: Gaussians, views: Sequence[LoadedView], conf: SplatConf
) -> dict[str, float | None]:
    """Score each view, at least one, as `score_views` does, without writing renders.

    Returns:
        Metric name -> mean over the views; None if it is not available.
    """
    gaussians, masked = _placed(gaussians, conf), _any_mask(views)
    rows = [_score(gaussians, view, conf, masked=masked)[1] for view in views]
    means: dict[str, float | None] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        known = [value for value in values if value is not None]
        means[name] = fmean(known) if len(known) == len(values) else None
    return means


def render_time(gaussians: Gaussians, views: Sequence[LoadedView], conf: SplatConf) -> float:
    """Measure the time of rendering a test view, the "runtime per frame" of the paper.

    Each view is rendered once to warm up and then timed, with torch's present number of threads, on
    the GPU if the backend is gsplat. The time is that from the model's parameters to the image, as
    in gsplat's trainer [ye2025]; the median over the views, at least one, is our choice. Arguments
    as for `score_views`.

    Returns:
        The median over the views, ms.
    """
    gaussians, seconds = _placed(gaussians, conf), []
    for view in views:
        _render(gaussians, view, conf)
        wait_for_gpu()
        start = time.perf_counter()
        _render(gaussians, view, conf)
        wait_for_gpu()
        seconds.append(time.perf_counter() - start)
    return 1e3 * median(seconds)


def _placed(gaussians: Gaussians, conf: SplatConf) -> Gaussians:
    """Return the Gaussians on the backend's device."""
    from xrgs.splat.backend import device, resolve_backend

    return gaussians.to(device(resolve_backend(conf.backend)))


def _render(gaussians: Gaussians, view: LoadedView, conf: SplatConf) -> Tensor:
    """Return the render [H, W, 3] of a view with all SH bands."""
    import torch

    from xrgs.splat.backend import resolve_backend
    from xrgs.splat.rendering import rasterize_parameters

    backend = resolve_backend(conf.backend)
    with torch.no_grad():
        return rasterize_parameters(
            *gaussians.activated(backend=backend),
            view.camera,
            conf.raster,
            sh_degree=conf.raster.sh_degree,
            backend=backend,
        ).image


def _any_mask(views: Sequence[LoadedView]) -> bool:
    return any(view.mask is not None for view in views)


def _score(
    gaussians: Gaussians, view: LoadedView, conf: SplatConf, *, masked: bool
) -> tuple[Tensor, dict[str, float | None]]:
    """Return the clamped render [H, W, 3] of a view, and its scores by name."""
    import torch

    image = _render(gaussians, view, conf).clamp(0.0, 1.0).cpu()
    with torch.no_grad(), torch_threads(1):  # the last digit of sums depends on threads
        scores = score_view(image, view.image, view.mask, masked=masked)
    return image, scores


def score_file(render: Path, view: View, *, masked: bool) -> dict[str, float | None]:
    """Score a render, an 8-bit RGB PNG of the view's size, by `xrgs.evaluation.metrics.score_view`.

    Raises:
        ImageError: A file is missing, damaged or of another size or mode; the message names it.
    """
    import torch

    size = view.width, view.height
    image, target = (torch.from_numpy(images.read_png(file, size)) for file in (render, view.file))
    mask = torch.from_numpy(images.read_mask(view.mask, size)) if view.mask else None
    with torch.no_grad(), torch_threads(1):
        return score_view(image, target, mask, masked=masked)
