"""The embedded scene with its exact cameras, and the depths of its views in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from xrgs.photos.scenes import procedural, still_life
from xrgs.splat.cameras import Camera
from xrgs.splat.normalize import normalize_scene
from xrgs.training.dataset import Dataset, LoadedView
from xrgs.training.dense.levels import Level

Array = NDArray[np.float64]

FACTOR = 4


@dataclass(frozen=True)
class TrueScene:
    """Views of the embedded scene, every third of them HR."""

    data: Dataset
    viewmats: Array
    """[C, 4, 4] the cameras in the scene's own world."""
    scale: float
    """The normalised world's units, of the scene's own."""

    def depths(self, number: int, level: Level) -> Array:
        """The exact depths [h, w] of a view's pixels, units of the normalised world."""
        (fx, fy), (cx, cy) = level.focal, level.centre
        height, width = level.gray.shape
        x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return self.scale * true_depths(rays, self.viewmats[number])


def true_depths(rays: Array, viewmat: Array) -> Array:
    """Intersect rays [h, w, 3] of a camera with the solids in float64; inf where they hit none."""
    turn, shift = viewmat[:3, :3], viewmat[:3, 3]
    nearest = np.full(rays.shape[:2], np.inf)
    for solid in still_life.solids():
        if isinstance(solid, still_life.Ball):
            centre = turn @ solid.centre.double().numpy() + shift
            square, along = (rays**2).sum(axis=-1), rays @ centre
            root = along**2 - square * (centre @ centre - solid.radius**2)
            depth = (along - np.sqrt(np.maximum(root, 0))) / square
            hit = root > 0
        else:
            corner = turn @ solid.corner.double().numpy() + shift
            u, v = (turn @ side.double().numpy() for side in (solid.u, solid.v))
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = (np.cross(u, v) @ corner) / (rays @ np.cross(u, v))
                place = rays * depth[..., None] - corner
            # The coordinates of the point in the basis u, v.
            a, b = np.moveaxis(place @ np.linalg.pinv(np.stack([u, v])), -1, 0)
            hit = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        nearest = np.where(hit & (depth > 0) & (depth < nearest), depth, nearest)
    return nearest


def true_scene(count: int, width: int, samples: int = 1, part: slice = slice(None)) -> TrueScene:
    """Render views of the embedded scene, `width` px wide, two thirds at `FACTOR` times less.

    Of `count` views only a part is rendered, by default all. A pixel of an HR view has the mean of
    `samples` x `samples`.
    """
    height = width * 3 // 4
    K, viewmats = procedural.intrinsics(width, height), procedural.viewmats(count)[part]
    textures = {name: still_life._pyramid(*of) for name, of in procedural.TEXTURES.items()}
    images = [
        still_life.render(
            *(still_life.solids(), textures, torch.from_numpy(K), torch.from_numpy(viewmat)),
            *(width, height, samples if number % 3 == 0 else 1),
        )
        for number, viewmat in enumerate(viewmats)
    ]
    points, colors = _points(K, viewmats, images)
    world = normalize_scene(viewmats, points)
    views = []
    for number, (image, viewmat) in enumerate(zip(images, world.viewmats, strict=True)):
        shrink = 1 if number % 3 == 0 else FACTOR
        small = avg_pool2d(image.movedim(-1, 0)[None], shrink)[0].movedim(0, -1).contiguous()
        full = Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(K).float(), width, height)
        camera = full.resized(small.shape[1], small.shape[0])
        pixels = (small * 255).round().to(torch.uint8)
        tag = "HR" if shrink == 1 else "LR"
        views.append(
            LoadedView(
                f"v{number}", tag, camera, pixels, sampling_rate=1 / shrink, supersampling=shrink
            )
        )
    points_of_scene = torch.from_numpy(world.points).float()
    data = Dataset(
        tuple(views), tuple(views[:1]), points_of_scene, colors, world.scene_scale, FACTOR
    )
    return TrueScene(data, viewmats, float(np.cbrt(np.linalg.det(world.transform[:3, :3]))))


@pytest.fixture(scope="session")
def scene() -> TrueScene:
    """Return twelve views of the embedded scene, 240 px wide, with exact poses."""
    return true_scene(12, 240)


def _points(K: Array, viewmats: Array, images: list[torch.Tensor]) -> tuple[Array, torch.Tensor]:
    """Points on the surfaces as SfM has them, 50 of each view, and their colours."""
    rng, points, colors = np.random.default_rng(0), [], []
    for viewmat, image in zip(viewmats, images, strict=True):
        row, column = (rng.integers(size, size=50) for size in image.shape[:2])
        x, y = (column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1]
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        depth = true_depths(rays[None], viewmat)[0]
        hit = np.isfinite(depth)
        points.append((rays[hit] * depth[hit, None] - viewmat[:3, 3]) @ viewmat[:3, :3])
        colors.append(image[torch.from_numpy(row[hit]), torch.from_numpy(column[hit])])
    return np.concatenate(points), torch.cat(colors)
