"""Region-aware weighting [xrgs, section 7.2, proposal 2]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import avg_pool2d

from xrgs.training.components.base import TrainingView
from xrgs.training.components.texture import gradient_magnitude

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import RegionWeightingConf
    from xrgs.splat.cameras import Camera

WINDOW = 5
"""Side, in px, of the square over which the texture of a pixel is averaged."""
NEAREST_POINTS = 5
"""Number of SfM points whose median depth is the depth of a pixel."""


def region_attenuations(
    settings: RegionWeightingConf, views: Sequence[TrainingView], points: Tensor, near: float
) -> dict[str, Tensor]:
    """Compute where each LR view is attenuated: where it is textured and an HR view covers it.

    The attenuation of a pixel is `min(1, g / texture)` where an HR view covers it, and 0 elsewhere,
    where g is `gradient_magnitude` averaged over 5 x 5 px. So smooth regions, and regions that no
    HR view sees, keep the full weight of LR supervision.

    Our choice where the paper is silent: section 7.2 proposes "spatially varying loss/gradient
    scaling so smooth regions retain LR supervision while textured regions benefit from XR-GS
    attenuation". The measure, its window and the condition of coverage are ours; `texture` is 0.07,
    as in adaptive weighting.

    Args:
        settings: The settings of region weighting; `texture`, in intensity per px, is above 0.
        views: All training views.
        points: [P, 3] SfM points, world units.
        near: Depth below which a point is not seen, world units.

    Returns:
        Attenuations [H, W] in 0..1, by the name of each LR view.
    """
    hr_cameras = [view.camera for view in views if view.tag == "HR"]
    attenuations = {}
    for view in views:
        if view.tag == "LR":
            texture = _box_mean(gradient_magnitude(view.image)) / settings.texture
            covered = coverage(view.camera, hr_cameras, points, near)
            attenuations[view.name] = texture.clamp_max(1.0) * covered
    return attenuations


def coverage(camera: Camera, others: Sequence[Camera], points: Tensor, near: float) -> Tensor:
    """Find the pixels of a view whose content another view samples more finely.

    The depth of a pixel is the median depth of the five SfM points that project nearest to it. The
    pixel is covered where its point at that depth projects into one of the other views, at more px
    per world unit than in its own. Occlusion is not tested, since a few points per view cannot
    separate the two sides of a depth edge. What an object hides from every other view therefore
    counts as covered.

    Args:
        camera: The camera of the view.
        others: The cameras of the other views.
        points: [P, 3] SfM points, world units.
        near: Depth below which a point is not seen, world units.

    Returns:
        [H, W] bool; False everywhere if no point projects into the view.
    """
    depth = _pixel_depths(camera, points, near)
    if depth is None:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    x, y = _pixel_centres(camera).unbind(-1)
    K = camera.K.to(points)
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    viewmat = camera.viewmat.to(points)
    # The product with the transposed rotation, in an order that does not depend on the processor.
    at_depth = (rays * depth[:, None] - viewmat[:3, 3])[..., None] * viewmat[:3, :3]
    world = at_depth[:, 0] + at_depth[:, 1] + at_depth[:, 2]  # [H W, 3]
    covered = torch.zeros(len(world), dtype=torch.bool)
    for other in others:
        pixels, z = _project(other, world)
        finer = other.K[0, 0] / z > K[0, 0] / depth
        covered |= (z > near) & _inside(pixels, other) & finer
    return covered.reshape(camera.height, camera.width)


def _pixel_depths(camera: Camera, points: Tensor, near: float) -> Tensor | None:
    """The depth of each pixel [H W] in row-major order; None where no point is in view."""
    pixels, z = _project(camera, points)
    seen = (z > near) & _inside(pixels, camera)
    count = int(seen.sum())
    if count == 0:
        return None
    ranks = range(1, min(NEAREST_POINTS, count) + 1)
    tree = KDTree(pixels[seen].numpy())
    _, nearest = tree.query(_pixel_centres(camera).numpy(), k=ranks)  # [H W, k]
    return z[seen][torch.from_numpy(nearest)].median(dim=1).values


def _pixel_centres(camera: Camera) -> Tensor:
    """The centres [H W, 2] of the pixels, x and y, in row-major order."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """The projections [P, 2] of points [P, 3], px, and their depths [P].

    The projection of a point with a depth of 0 or less has no meaning.
    """
    K = camera.K.to(points)
    x, y, z = camera.to_camera(points)
    pixels = torch.stack([x, y], dim=-1) / z[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels, z


def _inside(pixels: Tensor, camera: Camera) -> Tensor:
    """Whether each of the pixels [P, 2] lies on the image."""
    return ((pixels > 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))).all(dim=-1)


def _box_mean(values: Tensor) -> Tensor:
    """The mean [H, W] over the window around each pixel, over the part inside the image."""
    pooled = avg_pool2d(
        values[None, None], WINDOW, stride=1, padding=WINDOW // 2, count_include_pad=False
    )
    mean: Tensor = pooled[0, 0]
    return mean
