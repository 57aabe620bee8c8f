"""The frozen evaluation protocol: every test view at its full size, scored one by one.

Version 1: render with the training's settings and all SH bands, clamp to 0..1, score the float32
image against the 8-bit photograph / 255 with every metric of
`xrgs.evaluation.metrics.VIEW_METRICS`.
LPIPS needs weights that are not shipped. Only one file of them is accepted, so whether they are
there is not in a cell's identity: a cell scored without them is whole, and has no LPIPS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from xrgs.capture.dataset import LoadedView
    from xrgs.config import SplatConf
    from xrgs.splat.gaussians import Gaussians

#: Part of a cell's identity: raise it when a change here or in the metrics changes scores.
PROTOCOL = 1


def score(
    gaussians: Gaussians, views: Sequence[LoadedView], conf: SplatConf, renders: Path
) -> list[dict[str, Any]]:
    """Render and score each view; the clamped renders are kept as PNG.

    Returns:
        One row a view: `view` and each metric's value, None where the metric is not to be had.
    """
    import torch

    from xrgs.capture import images
    from xrgs.evaluation import metrics
    from xrgs.runtime.machine import one_thread
    from xrgs.runtime.progress import progress
    from xrgs.splat.backend import resolve_backend
    from xrgs.splat.rasterize import rasterize

    renders.mkdir(exist_ok=True)
    backend = resolve_backend(conf.backend)
    rows = []
    with torch.no_grad():
        for view in progress(views, "evaluating", "view"):
            render = rasterize(
                *gaussians.activated(),
                view.camera,
                conf.raster,
                sh_degree=conf.raster.sh_degree,
                backend=backend,
            )
            image = render.image.clamp(0.0, 1.0)
            with one_thread():  # torch's sum over several differs in the last digit
                scores = {name: fn(image, view.image) for name, fn in metrics.VIEW_METRICS.items()}
            rows.append({"view": view.name} | scores)
            images.save(renders / f"{view.name}.png", image.numpy())
    return rows
