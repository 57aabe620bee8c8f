"""A dense start: first Gaussians on the scene's surfaces, from multi-view stereo.

Training from SfM points spends its first steps on growing Gaussians in empty regions. A dense start
finds the surfaces in seconds. EDGS [kotovenko2025] uses matches of a network; here it is classical
multi-view stereo with the variant's poses:

1. A plane sweep [collins1996] compares every view with its nearest neighbours, at planes between
   the depths of its SfM points, evenly spaced in inverse depth (`depths`, `matching`).
2. Semi-global matching [hirschmuller2008] smooths the costs (`matching`).
3. A depth is kept if neighbours have it too, and more views confirm than contradict it (`depths`).
4. Each place of the scene is assigned to the view that samples it most finely.
5. A quadtree over the pixels assigned to each view is split where colours differ, until the number
   of leaves reaches the budget; each leaf becomes a Gaussian (`surface`).

The Gaussians on the SfM points are kept. A dense start would harm if few depths are consistent or
large parts of the views are not covered: then training starts from the SfM points, with a warning.

All is computed on the CPU in float32 and float64, with the same bits for any number of threads.
Masked pixels are ignored, and views may have any sizes.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.sh import colors_to_sh0
from xrgs.training.dense.levels import swept_views
from xrgs.training.dense.surface import Squares, cover, find_depths, share_covered, share_good

if TYPE_CHECKING:
    from xrgs.training.dataset import Dataset

BUDGET = 0.25
"""Largest number of added Gaussians, per pixel of the largest training view: 48,000 at
504 x 378 px; our choice."""
OPACITY = 0.3
"""Opacity of each added Gaussian; our choice."""
SCALE = 0.5
"""Scale of each added Gaussian, as a multiple of the side of its square; our choice."""
LEAST_GOOD = 0.6
"""Least fraction of the views' pixels with a consistent depth; our choice."""
LEAST_COVERED = 0.8
"""Least fraction of the views' area that the added Gaussians cover; our choice."""

_log = logging.getLogger(__name__)


def dense_start(
    data: Dataset, sparse: Gaussians, backend: str, generator: torch.Generator
) -> Gaussians:
    """Add Gaussians on the surfaces of a scene to those on its SfM points, `sparse`.

    Args:
        data: The training views and the SfM points.
        sparse: The Gaussians on the SfM points.
        backend: `torch` or `native`: the implementation of resampling and of the plane sweep.
        generator: Draws the quaternions.

    Returns:
        The Gaussians on SfM points, then those on surfaces; `sparse` itself if a dense start would
        harm.
    """
    views = swept_views(data.train, backend)
    maps = list(find_depths(views, data.points.double().numpy(), backend).values())
    good = share_good(views, maps)
    if good < LEAST_GOOD:
        return _off(sparse, f"{good:.0%} of the depths hold in several views", LEAST_GOOD)
    squares = cover(maps, max(1, round(BUDGET * data.view_pixels)))
    covered = share_covered(views, squares.points)
    if covered < LEAST_COVERED:
        return _off(sparse, f"{covered:.0%} of the training views are covered", LEAST_COVERED)
    _log.info(
        "dense start: %d Gaussians beside %d SfM points; %.0f%% of the depths hold, %.0f%% of the"
        " training views are covered",
        *(len(squares.points), len(sparse), 100 * good, 100 * covered),
    )
    return _joined(sparse, squares, generator)


def _off(sparse: Gaussians, why: str, least: float) -> Gaussians:
    _log.warning(
        "splat.init=dense: off, since only %s, and at least %.0f%% are needed: training starts from"
        " the SfM points",
        *(why, 100 * least),
    )
    return sparse


def _joined(sparse: Gaussians, squares: Squares, generator: torch.Generator) -> Gaussians:
    count = len(squares.points)
    log_scales = torch.from_numpy(np.log(SCALE * squares.sides)).float()  # [N]
    added = {
        "means": torch.from_numpy(squares.points).float(),
        "quats": torch.rand((count, 4), generator=generator),
        "scales": log_scales[:, None].repeat(1, 3),
        "opacities": torch.full((count,), math.log(OPACITY / (1 - OPACITY))),
        "sh0": colors_to_sh0(torch.from_numpy(squares.colors).float()),
        "shN": torch.zeros((count, *sparse.shN.shape[1:])),
    }
    both = {name: torch.cat([sparse[name].detach(), added[name]]) for name in PARAMETERS}
    return Gaussians(**{name: value.requires_grad_() for name, value in both.items()})
