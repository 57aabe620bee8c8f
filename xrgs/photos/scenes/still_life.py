"""Builds the solids of the procedural scene, at several depths, and renders its views."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from xrgs.photos import images
from xrgs.photos.scenes import raycast
from xrgs.photos.scenes.raycast import Ball, Pyramid, Quad, pyramid
from xrgs.photos.scenes.scene import bundled_photograph
from xrgs.runtime.machine import single_torch_thread
from xrgs.runtime.progress import progress

#: Samples per pixel along each axis.
SUPERSAMPLE = 3


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


def render(
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
        image = raycast.render(scene, pyramids, torch.from_numpy(K), pose, *size, SUPERSAMPLE)
        images.save(folder / f"{name}.png", image.numpy(), durable=False)

    # One thread per view, and none within: on a busy machine torch's threads wait for each other.
    with single_torch_thread() as threads, ThreadPoolExecutor(threads) as pool:
        done = pool.map(render_view, viewmats)
        for _ in progress(done, "rendering the scene", "view", len(viewmats)):
            pass


def _pyramid(photograph: str, tint: tuple[float, float, float]) -> Pyramid:
    """Build the pyramid of a bundled photograph whose channels are multiplied by a tint."""
    tinted = images.read(bundled_photograph(photograph)) * np.array(tint, np.float32)
    return pyramid(torch.from_numpy(tinted).movedim(-1, 0))
