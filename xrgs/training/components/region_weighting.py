"""Region-aware weighting (paper 7.2, 2)."""

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
"""Side, px, of the square that a pixel's texture is the mean of."""
NEIGHBOURS = 5
"""SfM points whose median depth a pixel takes."""


def region_shares(
    conf: RegionWeightingConf, views: Sequence[TrainingView], points: Tensor, near: float
) -> dict[str, Tensor]:
    """Where in each LR view the attenuation stays: textured, and covered by an HR view.

    A pixel's share is `min(1, g / texture)` where an HR view covers it and 0 elsewhere: smooth
    regions, and what no HR view can teach, keep the full weight of LR supervision (paper 7.2, 2).
    g is the gradient's magnitude, averaged over 5 x 5 px. The paper says neither how texture is
    measured nor that coverage matters; `texture` is `adaptive_weighting`'s.

    Args:
        conf: Of region weighting.
        views: Every training view.
        points: [P, 3] SfM points, world units.
        near: Nearest depth that is seen, world units.

    Returns:
        [H, W] in 0..1, for each LR view by its name.
    """
    high = [view.camera for view in views if view.tag == "HR"]
    shares = {}
    for view in views:
        if view.tag == "LR":
            texture = _smoothed(gradient_magnitude(view.image)) / conf.texture
            covered = coverage(view.camera, high, points, near)
            shares[view.name] = texture.clamp_max(1.0) * covered
    return shares


def coverage(camera: Camera, others: Sequence[Camera], points: Tensor, near: float) -> Tensor:
    """Which pixels of a view show something that one of `others` samples more finely.

    A pixel's depth is the median of the five SfM points nearest to it in the image. Where that puts
    it is projected into the other views: inside one of them, and at more pixels a world unit than
    here, it is covered. Occlusion is not looked at: a few points a view can't tell the far side of
    an edge from the near one. So what an object hides from every HR view counts as covered.

    Returns:
        [H, W] bool; False everywhere if the view has no point in it.
    """
    depth = _depths(camera, points, near)
    if depth is None:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    x, y = _pixels(camera).unbind(-1)
    K = camera.K.to(points)
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    viewmat = camera.viewmat.to(points)
    world = (rays * depth[:, None] - viewmat[:3, 3]) @ viewmat[:3, :3]  # [H W, 3]
    covered = torch.zeros(len(world), dtype=torch.bool)
    for other in others:
        flat, z = _project(other, world)
        finer = other.K[0, 0] / z > K[0, 0] / depth
        covered |= (z > near) & _inside(flat, other) & finer
    return covered.reshape(camera.height, camera.width)


def _depths(camera: Camera, points: Tensor, near: float) -> Tensor | None:
    """Of each pixel, in row-major order [H W]; None where no point is in view."""
    flat, z = _project(camera, points)
    seen = (z > near) & _inside(flat, camera)
    count = int(seen.sum())
    if count == 0:
        return None
    nearest = range(1, min(NEIGHBOURS, count) + 1)
    _, index = KDTree(flat[seen].numpy()).query(_pixels(camera).numpy(), k=nearest)  # [H W, k]
    return z[seen][torch.from_numpy(index)].median(dim=1).values


def _pixels(camera: Camera) -> Tensor:
    """Centres [H W, 2], x and y."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Where points [P, 3] fall, [P, 2] px, and their depth [P]; of those behind, anywhere."""
    viewmat, K = camera.viewmat.to(points), camera.K.to(points)
    inside = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = inside[:, 2]
    flat = inside[:, :2] / z[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    return flat, z


def _inside(flat: Tensor, camera: Camera) -> Tensor:
    return ((flat > 0) & (flat < flat.new_tensor([camera.width, camera.height]))).all(dim=-1)


def _smoothed(values: Tensor) -> Tensor:
    """[H, W]: the mean of the window around each pixel, of what of it lies inside."""
    pooled = avg_pool2d(
        values[None, None], WINDOW, stride=1, padding=WINDOW // 2, count_include_pad=False
    )
    smoothed: Tensor = pooled[0, 0]
    return smoothed
