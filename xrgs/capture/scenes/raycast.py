"""Textured parallelograms and balls, ray-cast with supersampling: exact images of a known world.

Camera rays are cut with every solid inside the pixels that can see it; the nearest hit is kept, and
its texture is read at the pyramid level whose texels are as large as the sample's footprint, so
that supersampling only has edges left to smooth. Colours are averaged as stored (sRGB). There is
no view-dependent effect: every point has one colour in all views.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

_NEAR = 0.05
#: The light comes from above, the left and the cameras' side (y points down).
_LIGHT = torch.tensor([-0.35, -0.75, -0.56])
_AMBIENT = 0.75
#: A ball's texture is centred on its -z pole and reaches the border this far round, in radians.
_BALL_REACH = 0.6 * math.pi

Pyramid = list[Tensor]
Hits = tuple[Tensor, ...]  # rows [m], columns [m]


@dataclass(frozen=True)
class Quad:
    """The parallelogram corner + a u + b v with a, b in 0..1; (a, b) is its texture coordinate."""

    texture: str
    corner: Tensor  # [3]
    u: Tensor  # [3]
    v: Tensor  # [3]


@dataclass(frozen=True)
class Ball:
    """A sphere whose texture is laid over the side that faces -z (azimuthal equidistant)."""

    texture: str
    centre: Tensor  # [3]
    radius: float


def pyramid(texture: Tensor) -> Pyramid:
    """Halved copies of a texture [3, h, w], finest first, down to 2 texels."""
    levels = [texture]
    while min(levels[-1].shape[1:]) >= 4:
        levels.append(avg_pool2d(levels[-1][None], 2)[0])
    return levels


class _Samples:
    """The nearest hit of every sample of one view: solid, texture place, shade, footprint."""

    def __init__(self, K: Tensor, width: int, height: int, supersample: int) -> None:
        rows, columns = height * supersample, width * supersample
        self.focal = K[[0, 1], [0, 1]] * supersample
        self.x = ((torch.arange(columns) + 0.5) / supersample - K[0, 2]) / K[0, 0]  # [w]
        self.y = ((torch.arange(rows) + 0.5) / supersample - K[1, 2])[:, None] / K[1, 1]  # [h, 1]
        self.depth = torch.full((rows, columns), math.inf)
        self.solid = torch.full((rows, columns), -1, dtype=torch.int16)
        self.place = torch.zeros(rows, columns, 2)
        self.shade = torch.zeros(rows, columns)
        self.texels = torch.zeros(rows, columns)  # area of a sample, as a share of the texture
        self.windows: dict[int, tuple[slice, slice]] = {}  # where each solid may be found

    def window(self, corners: Tensor) -> tuple[slice, slice]:
        """The samples that may see the hull of camera-space `corners` [n, 3]."""
        h, w = self.depth.shape
        if bool((corners[:, 2] <= _NEAR).any()):
            return slice(0, h), slice(0, w)
        x, y = corners[:, 0] / corners[:, 2], corners[:, 1] / corners[:, 2]
        left = int(torch.searchsorted(self.x, x.min()))
        right = int(torch.searchsorted(self.x, x.max()))
        top = int(torch.searchsorted(self.y[:, 0], y.min()))
        bottom = int(torch.searchsorted(self.y[:, 0], y.max()))
        return slice(top, bottom), slice(left, right)

    def nearer(self, window: tuple[slice, slice], depth: Tensor, inside: Tensor) -> Hits:
        """Where (in the window) a solid is in front of all before; keeps the depth there."""
        seen = self.depth[window]
        hits = (inside & (depth > _NEAR) & (depth < seen)).nonzero(as_tuple=True)
        seen[hits] = depth[hits]
        return hits

    def keep(
        self,
        window: tuple[slice, slice],
        hits: Hits,
        index: int,
        place: Tensor,
        shade: Tensor,
        texels: Tensor,
    ) -> None:
        """Record solid `index` at `hits`: texture place [m, 2], shade and footprint [m]."""
        if not len(hits[0]):
            return
        self.windows[index] = window
        self.solid[window][hits] = index
        self.place[window][hits] = place
        self.shade[window][hits] = shade
        self.texels[window][hits] = texels


def _shade(normal: Tensor) -> Tensor:
    """Lambert's cosine over an ambient floor; normals [..., 3] of unit length, world axes."""
    cosine: Tensor = normal @ (_LIGHT / _LIGHT.norm())
    return _AMBIENT + (1 - _AMBIENT) * cosine.clamp(min=0)


def _cut_quad(samples: _Samples, index: int, quad: Quad, viewmat: Tensor) -> None:
    rotation, offset = viewmat[:3, :3], viewmat[:3, 3]
    o, u, v = rotation @ quad.corner + offset, rotation @ quad.u, rotation @ quad.v
    window = samples.window(torch.stack([o, o + u, o + v, o + u + v]))
    x, y = samples.x[window[1]], samples.y[window[0]]
    n = torch.linalg.cross(u, v)
    depth = (n @ o) / (n[0] * x + n[1] * y + n[2])  # of the ray (x, y, 1)
    # Dual basis: a and b are linear in the point, so a corner's rounding can't shear the texture.
    to_a = torch.linalg.cross(v, n) / (n @ n)
    to_b = torch.linalg.cross(n, u) / (n @ n)
    a = depth * (to_a[0] * x + to_a[1] * y + to_a[2]) - to_a @ o
    b = depth * (to_b[0] * x + to_b[1] * y + to_b[2]) - to_b @ o
    hits = samples.nearer(window, depth, (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1))
    facing = -torch.sign(n @ o)
    shade = _shade(facing * torch.linalg.cross(quad.u, quad.v) / n.norm())
    # The map from (a, b) to the plane z = 1 has determinant (n·o) / depth³.
    texels = depth[hits] ** 3 / ((n @ o).abs() * samples.focal.prod())
    samples.keep(window, hits, index, torch.stack([a[hits], b[hits]], -1), shade, texels)


def _cut_ball(samples: _Samples, index: int, ball: Ball, viewmat: Tensor) -> None:
    rotation, offset = viewmat[:3, :3], viewmat[:3, 3]
    c = rotation @ ball.centre + offset
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    window = samples.window(c + ball.radius * signs)
    x, y = samples.x[window[1]], samples.y[window[0]]
    dd = x**2 + y**2 + 1
    dc = c[0] * x + c[1] * y + c[2]
    root = dc**2 - dd * (c @ c - ball.radius**2)
    depth = (dc - root.clamp(min=0).sqrt()) / dd
    hits = samples.nearer(window, depth, root > 0)
    dd, dc, depth = dd[hits], dc[hits], depth[hits]  # [m]
    ray = torch.stack([x[hits[1]], y[hits[0], 0], torch.ones_like(depth)], -1)
    normal = (depth[:, None] * ray - c) / ball.radius @ rotation  # [m, 3] world axes
    angle = torch.acos((-normal[:, 2]).clamp(-1, 1))
    spread = 0.5 * angle / _BALL_REACH / torch.hypot(normal[:, 0], normal[:, 1]).clamp(min=1e-6)
    place = 0.5 + spread[:, None] * normal[:, :2]
    per_unit = 0.5 / (_BALL_REACH * ball.radius)  # texture lengths per world length
    cosine = ((dc - depth * dd) / (ball.radius * dd.sqrt())).clamp(min=0.05)
    texels = per_unit**2 * depth**2 / (cosine * samples.focal.prod())
    samples.keep(window, hits, index, place, _shade(normal), texels)


def _colour(
    samples: _Samples, solids: Sequence[Quad | Ball], textures: Mapping[str, Pyramid]
) -> Tensor:
    """Texture times shade of every sample, [h, w, 3]."""
    image = torch.zeros(*samples.depth.shape, 3)
    for index, window in samples.windows.items():
        hits = (samples.solid[window] == index).nonzero(as_tuple=True)
        if not len(hits[0]):  # hidden by what was cut later
            continue
        levels = textures[solids[index].texture]
        area = samples.texels[window][hits] * levels[0][0].numel()
        level = (0.5 * torch.log2(area.clamp(min=1e-9))).round().clamp(0, len(levels) - 1)
        place = samples.place[window][hits] * 2 - 1
        colour = torch.empty(len(level), 3)
        for k in range(int(level.min()), int(level.max()) + 1):
            chosen = (level == k).nonzero()[:, 0]
            texture, at = levels[k][None], place[None, None, chosen]
            found = grid_sample(texture, at, padding_mode="border", align_corners=False)
            colour[chosen] = found[0, :, 0].T
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
    """The image [height, width, 3] in 0..1 that a pinhole camera takes of the solids.

    Args:
        solids: What is seen, in world units.
        textures: Pyramids of [3, h, w] by name, see `pyramid`.
        K: [3, 3] px, pixel centres at +0.5.
        viewmat: [4, 4] world to camera, OpenCV axes.
        width: px.
        height: px.
        supersample: Samples per pixel along each axis, evenly spaced.

    Where nothing is hit the image is black.
    """
    K, viewmat = K.float(), viewmat.float()
    samples = _Samples(K, width, height, supersample)
    for index, solid in enumerate(solids):
        cut = _cut_quad if isinstance(solid, Quad) else _cut_ball
        cut(samples, index, solid, viewmat)  # type: ignore[arg-type]
    image = _colour(samples, solids, textures).movedim(-1, 0)[None]
    return avg_pool2d(image, supersample)[0].movedim(0, -1)
