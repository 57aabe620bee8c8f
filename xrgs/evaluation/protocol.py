"""The frozen evaluation protocol: scores every test view at its full size, one by one.

Version 1: render with the settings of the training and all SH bands, clamp to 0..1, and score the
float32 image against the 8-bit photograph / 255 with every metric of
`xrgs.evaluation.metrics.VIEW_METRICS`.

LPIPS needs weights that are not shipped. Only the published ones are accepted, so whether a machine
has them is not in a cell's identity: a cell scored without them is complete, and has no LPIPS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.capture.dataset import LoadedView
    from xrgs.config import SplatConf
    from xrgs.safeio.confined import ConfinedPath
    from xrgs.splat.gaussians import Gaussians

#: The version of this protocol, part of a cell's identity: increment it when a change here or in
#: the metrics changes scores.
PROTOCOL_VERSION = 1


def score_views(
    gaussians: Gaussians, views: Sequence[LoadedView], conf: SplatConf, renders: ConfinedPath
) -> list[dict[str, Any]]:
    """Render and score each view, and write its clamped render as `<view>.png`.

    The renders are not waited for until they are on the disk: `CellFolder.finish` does that.

    Args:
        gaussians: The trained model.
        views: The test views, at full size.
        conf: The model's settings: the rasterizer's, and the backend.
        renders: The folder for the renders, made where it is missing; its parent must exist.

    Returns:
        One row per view: its name under `view`, and each metric's value under the metric's name,
        None where the metric is not available.
    """
    import torch

    from xrgs.capture import images
    from xrgs.evaluation import metrics
    from xrgs.runtime.machine import single_torch_thread
    from xrgs.runtime.progress import progress
    from xrgs.splat.backend import resolve_backend
    from xrgs.splat.rasterize import rasterize_parameters

    renders.make_folder()
    backend = resolve_backend(conf.backend)
    rows = []
    with torch.no_grad():
        for view in progress(views, "evaluating", "view"):
            render = rasterize_parameters(
                *gaussians.activated(backend=backend),
                view.camera,
                conf.raster,
                sh_degree=conf.raster.sh_degree,
                backend=backend,
            )
            image = render.image.clamp(0.0, 1.0)
            with single_torch_thread():  # sums over several threads differ in the last digit
                scores = {name: fn(image, view.image) for name, fn in metrics.VIEW_METRICS.items()}
            rows.append({"view": view.name} | scores)
            images.save(renders / f"{view.name}.png", image.numpy(), durable=False)
    return rows
