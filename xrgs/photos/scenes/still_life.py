"""Builds the solids of the procedural scene, and renders its views: exact images of a known scene.

The solids are textured parallelograms and balls, at several depths. Each is intersected with the
camera rays of the pixels that can show it. Each ray keeps its nearest hit, and reads the texture at
the pyramid level whose texels are as large as the footprint of a sample, so that supersampling only
has edges left to smooth. Colours are averaged as they are stored (sRGB). Nothing depends on the
view direction: every point has one colour in all views.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from xrgs.photos import images
from xrgs.photos.scenes.scene import bundled_photograph
from xrgs.runtime.machine import on_threads
from xrgs.runtime.progress import progress

_NEAR = 0.05
#: The direction towards the light: above, left, and on the cameras' side (y points down).
_LIGHT = torch.tensor([-0.35, -0.75, -0.56], dtype=torch.float32, device="cpu")
_AMBIENT = 0.75
#: The angle from a ball's -z pole, the centre of its texture, at which the texture ends, radians.
_BALL_REACH = 0.6 * math.pi

Pyramid = list[Tensor]
Hits = tuple[Tensor, ...]  # rows [m], columns [m]
#: Samples per pixel along each axis.
SUPERSAMPLE = 3


@dataclass(frozen=True)
class Quad:
    """The parallelogram corner + a u + b v, where (a, b) in 0..1 is the texture coordinate."""

    texture: str
    """The name of its texture."""
    corner: Tensor  # [3]
    u: Tensor  # [3]
    v: Tensor  # [3]


@dataclass(frozen=True)
class Ball:
    """A sphere with a texture on its -z side, by the azimuthal equidistant projection."""

    texture: str
    """The name of its texture."""
    centre: Tensor  # [3]
    radius: float


def pyramid(texture: Tensor) -> Pyramid:
    """Halve a texture [3, h, w] repeatedly, down to 2 texels; the finest level is first."""
    levels = [texture]
    while min(levels[-1].shape[1:]) >= 4:
        levels.append(avg_pool2d(levels[-1][None], 2)[0])
    return levels


class _Samples:
    """The nearest hit of every sample of one view: solid, texture coordinate, shade, footprint."""

    def __init__(self, K: Tensor, width: int, height: int, supersample: int) -> None:
        rows, columns = height * supersample, width * supersample
        self.focal = K[[0, 1], [0, 1]] * supersample
        self.x = ((torch.arange(columns) + 0.5) / supersample - K[0, 2]) / K[0, 0]  # [w]
        self.y = ((torch.arange(rows) + 0.5) / supersample - K[1, 2])[:, None] / K[1, 1]  # [h, 1]
        self.depth = torch.full((rows, columns), math.inf)
        self.solid = torch.full((rows, columns), -1, dtype=torch.int16)
        self.uv = torch.zeros(rows, columns, 2)
        self.shade = torch.zeros(rows, columns)
        self.texels = torch.zeros(rows, columns)  # footprint, as a fraction of the texture's area
        self.windows: dict[int, tuple[slice, slice]] = {}  # the samples that may show each solid

    def window(self, corners: Tensor) -> tuple[slice, slice]:
        """Return the samples that may show the hull of camera-space `corners` [n, 3]."""
        h, w = self.depth.shape
        if bool((corners[:, 2] <= _NEAR).any()):
            return slice(0, h), slice(0, w)
        x, y = corners[:, 0] / corners[:, 2], corners[:, 1] / corners[:, 2]
        left = int(torch.searchsorted(self.x, x.min()))
        right = int(torch.searchsorted(self.x, x.max()))
        top = int(torch.searchsorted(self.y[:, 0], y.min()))
        bottom = int(torch.searchsorted(self.y[:, 0], y.max()))
        return slice(top, bottom), slice(left, right)

    def update_depth(self, window: tuple[slice, slice], depth: Tensor, inside: Tensor) -> Hits:
        """Find where in the window a solid is nearer than all before, and store its depth there."""
        nearest = self.depth[window]
        hits = (inside & (depth > _NEAR) & (depth < nearest)).nonzero(as_tuple=True)
        nearest[hits] = depth[hits]
        return hits

    def store(
        self,
        window: tuple[slice, slice],
        hits: Hits,
        index: int,
        uv: Tensor,
        shade: Tensor,
        texels: Tensor,
    ) -> None:
        """Store solid `index` at `hits`: texture coordinate [m, 2], shade and footprint [m]."""
        if not len(hits[0]):
            return
        self.windows[index] = window
        self.solid[window][hits] = index
        self.uv[window][hits] = uv
        self.shade[window][hits] = shade
        self.texels[window][hits] = texels


def _shade(normal: Tensor) -> Tensor:
    """Compute Lambert's cosine plus ambient light, from unit normals [..., 3] in world axes."""
    cosine: Tensor = normal @ (_LIGHT / _LIGHT.norm())
    return _AMBIENT + (1 - _AMBIENT) * cosine.clamp(min=0)


def _intersect_quad(samples: _Samples, index: int, quad: Quad, viewmat: Tensor) -> None:
    rotation, offset = viewmat[:3, :3], viewmat[:3, 3]
    o, u, v = rotation @ quad.corner + offset, rotation @ quad.u, rotation @ quad.v
    window = samples.window(torch.stack([o, o + u, o + v, o + u + v]))
    x, y = samples.x[window[1]], samples.y[window[0]]
    n = torch.linalg.cross(u, v)
    depth = (n @ o) / (n[0] * x + n[1] * y + n[2])  # of the ray (x, y, 1)
    # With the dual basis a and b are linear in the point, so that rounding can't shear the texture.
    to_a = torch.linalg.cross(v, n) / (n @ n)
    to_b = torch.linalg.cross(n, u) / (n @ n)
    a = depth * (to_a[0] * x + to_a[1] * y + to_a[2]) - to_a @ o
    b = depth * (to_b[0] * x + to_b[1] * y + to_b[2]) - to_b @ o
    hits = samples.update_depth(window, depth, (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1))
    facing = -torch.sign(n @ o)
    shade = _shade(facing * torch.linalg.cross(quad.u, quad.v) / n.norm())
    # The map from (a, b) to the plane z = 1 has determinant (n·o) / depth³.
    texels = depth[hits] ** 3 / ((n @ o).abs() * samples.focal.prod())
    samples.store(window, hits, index, torch.stack([a[hits], b[hits]], -1), shade, texels)


def _intersect_ball(samples: _Samples, index: int, ball: Ball, viewmat: Tensor) -> None:
    rotation, offset = viewmat[:3, :3], viewmat[:3, 3]
    c = rotation @ ball.centre + offset
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    window = samples.window(c + ball.radius * signs)
    x, y = samples.x[window[1]], samples.y[window[0]]
    dd = x**2 + y**2 + 1
    dc = c[0] * x + c[1] * y + c[2]
    root = dc**2 - dd * (c @ c - ball.radius**2)
    depth = (dc - root.clamp(min=0).sqrt()) / dd
    hits = samples.update_depth(window, depth, root > 0)
    dd, dc, depth = dd[hits], dc[hits], depth[hits]  # [m]
    ray = torch.stack([x[hits[1]], y[hits[0], 0], torch.ones_like(depth)], -1)
    normal = (depth[:, None] * ray - c) / ball.radius @ rotation  # [m, 3] world axes
    angle = torch.acos((-normal[:, 2]).clamp(-1, 1))
    spread = 0.5 * angle / _BALL_REACH / torch.hypot(normal[:, 0], normal[:, 1]).clamp(min=1e-6)
    uv = 0.5 + spread[:, None] * normal[:, :2]
    per_unit = 0.5 / (_BALL_REACH * ball.radius)  # texture lengths per world unit
    cosine = ((dc - depth * dd) / (ball.radius * dd.sqrt())).clamp(min=0.05)
    texels = per_unit**2 * depth**2 / (cosine * samples.focal.prod())
    samples.store(window, hits, index, uv, _shade(normal), texels)


def _colour(
    samples: _Samples, solids: Sequence[Quad | Ball], textures: Mapping[str, Pyramid]
) -> Tensor:
    """Compute texture times shade of every sample, [h, w, 3]."""
    image = torch.zeros(*samples.depth.shape, 3)
    for index, window in samples.windows.items():
        hits = (samples.solid[window] == index).nonzero(as_tuple=True)
        if not len(hits[0]):  # hidden by a solid that came later
            continue
        levels = textures[solids[index].texture]
        area = samples.texels[window][hits] * levels[0][0].numel()
        level = (0.5 * torch.log2(area.clamp(min=1e-9))).round().clamp(0, len(levels) - 1)
        uv = samples.uv[window][hits] * 2 - 1
        colour = torch.empty(len(level), 3)
        for k in range(int(level.min()), int(level.max()) + 1):
            chosen = (level == k).nonzero()[:, 0]
            texture, at = levels[k][None], uv[None, None, chosen]
            sampled = grid_sample(texture, at, padding_mode="border", align_corners=False)
            colour[chosen] = sampled[0, :, 0].T
        image[window][hits] = colour * samples.shade[window][hits][:, None]
    return image


def render(
    solids: Sequence[Quad | Ball],
    textures: Mapping[str, Pyramid],
    K: Tensor,
    viewmat: Tensor,
    width: int,
    height: int,
    supersample: int = 3,
) -> Tensor:
    """Render solids by a pinhole camera: [height, width, 3] in 0..1, black where no solid is hit.

    Args:
        solids: The solids, in world units.
        textures: Pyramids of [3, h, w] by name, see `pyramid`.
        K: Intrinsics [3, 3], px; pixel centres at +0.5.
        viewmat: World to camera [4, 4], OpenCV axes.
        width: Width of the image, px.
        height: Height of the image, px.
        supersample: The number of evenly spaced samples per pixel along each axis.
    """
    K, viewmat = K.float(), viewmat.float()
    samples = _Samples(K, width, height, supersample)
    for index, solid in enumerate(solids):
        intersect = _intersect_quad if isinstance(solid, Quad) else _intersect_ball
        intersect(samples, index, solid, viewmat)  # type: ignore[arg-type]
    image = _colour(samples, solids, textures).movedim(-1, 0)[None]
    return avg_pool2d(image, supersample)[0].movedim(0, -1)


def _upright_quad(
    texture: str, left: float, top: float, width: float, height: float, z: float
) -> Quad:
    """Make an upright rectangle that faces the cameras; a negative size mirrors its texture."""
    corner = torch.tensor([left, top, z])
    return Quad(texture, corner, torch.tensor([width, 0.0, 0.0]), torch.tensor([0.0, height, 0.0]))


def _level_quad(
    texture: str, left: float, y: float, width: float, far: float, length: float
) -> Quad:
    """Make a level rectangle from z = `far` towards the cameras; a negative width mirrors it."""
    depth = torch.tensor([0.0, 0.0, -length])
    return Quad(texture, torch.tensor([left, y, far]), torch.tensor([width, 0.0, 0.0]), depth)


def _box(
    texture: str, foot: tuple[float, float, float], size: tuple[float, float, float], turn: float
) -> Iterator[Quad]:
    """Yield front, sides and top of a box on the point `foot`, turned by `turn` degrees."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    w = size[0] * torch.tensor([c, 0.0, s])
    h = torch.tensor([0.0, size[1], 0.0])
    d = size[2] * torch.tensor([-s, 0.0, c])
    near = torch.tensor(foot) - h - (w + d) / 2
    yield Quad(texture, near, w, h)
    yield Quad(texture, near + w, d, h)
    yield Quad(texture, near + d, -d, h)
    yield Quad(texture, near + d, w, -d)


def solids() -> list[Quad | Ball]:
    """Return the solids of the scene, in world units."""
    floor = 1.5
    result: list[Quad | Ball] = []
    # Mirrored tiles give fine texture without a period, which SfM could mistake for one place.
    for x, y in itertools.product((-7.0, 7.0), (-4.0, 4.0)):
        result.append(_upright_quad("brick", 0.0, -1.5, x, y, 8.0))
    for left, width, far in itertools.product((-3.0, 3.0), (-3.0, 3.0), (8.0, 4.5)):
        result.append(_level_quad("gravel", left, floor, width, far, 3.5))
    result += [
        _upright_quad("astronaut", -4.3, -3.1, 2.0, 2.0, 7.9),
        _upright_quad("coins", -2.0, -3.3, 1.5, 1.18, 7.9),
        _upright_quad("page", -0.2, -3.2, 1.6, 0.8, 7.9),
        _upright_quad("stars", 1.7, -3.2, 2.4, 2.09, 7.9),
        _upright_quad("leaves", -4.5, -0.5, 2.0, 2.0, 7.4),
        _upright_quad("leaves", -0.5, -0.5, -2.0, 2.0, 7.4),
        _upright_quad("leaves", -0.5, -0.5, 2.0, 2.0, 7.4),
        _upright_quad("leaves", 3.5, -0.5, -2.0, 2.0, 7.4),
        _upright_quad("tissue", -1.75, -1.6, 1.3, 1.3, 6.9),
        Ball("retina", torch.tensor([0.9, -0.9, 6.1]), 0.55),
        Ball("moon", torch.tensor([0.15, 0.95, 4.6]), 0.55),
        Ball("leaves", torch.tensor([3.2, 0.75, 6.6]), 0.9),
        Ball("coins", torch.tensor([1.15, 1.2, 3.9]), 0.3),
    ]
    result += _box("coffee", (-1.75, floor, 5.3), (1.3, 1.1, 1.0), 28.0)
    result += _box("rocket", (1.95, floor, 5.4), (1.0, 1.9, 0.8), -32.0)
    result += _box("cat", (-3.1, floor, 6.6), (1.5, 2.0, 0.6), 20.0)
    result += _box("page", (-0.6, floor, 3.7), (0.5, 0.25, 0.7), -20.0)
    for k in range(6):  # thin rails in front of everything, for edges with disocclusions
        foot = (-2.1 + 0.16 * k, floor, 3.4 + 0.12 * k)
        result += _box("bark", foot, (0.05, 1.6, 0.05), 15.0 * k)
    return result


def render_views(
    folder: Path,
    textures: Mapping[str, tuple[str, tuple[float, float, float]]],
    K: NDArray[np.float64],
    size: tuple[int, int],
    viewmats: Mapping[str, NDArray[np.float64]],
) -> None:
    """Render every view and write it as `<name>.png`, without waiting for the disk.

    Args:
        folder: An existing folder for the images.
        textures: The bundled photograph and the RGB tint of each texture, by the texture's name.
        K: Intrinsics [3, 3] of every view, px.
        size: Width and height of the views, px.
        viewmats: World-to-camera matrix [4, 4] of each view, by the view's name.
    """
    scene, pyramids = solids(), {name: _pyramid(*of) for name, of in textures.items()}

    def render_view(name: str) -> None:
        pose = torch.from_numpy(viewmats[name])
        image = render(scene, pyramids, torch.from_numpy(K), pose, *size, SUPERSAMPLE)
        images.save(folder / f"{name}.png", image.numpy(), durable=False)

    done = on_threads(render_view, viewmats)
    for _ in progress(done, "rendering the scene", "view", len(viewmats)):
        pass


def _pyramid(photograph: str, tint: tuple[float, float, float]) -> Pyramid:
    """Build the pyramid of a bundled photograph whose channels are multiplied by a tint."""
    tinted = images.read(bundled_photograph(photograph)) * np.array(tint, np.float32)
    return pyramid(torch.from_numpy(tinted).movedim(-1, 0))
