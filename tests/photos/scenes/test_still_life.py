"""The solids of the procedural scene, and its rendering."""

from __future__ import annotations

import math

import pytest
import torch

from xrgs.photos.scenes import procedural, still_life
from xrgs.photos.scenes.still_life import Ball, Pyramid, Quad, pyramid, render


def test_every_pixel_shows_a_solid() -> None:
    width, height = procedural.camera_size(64)
    K = torch.from_numpy(procedural.intrinsics(width, height))
    white = {name: pyramid(torch.ones(3, 4, 4)) for name in procedural.TEXTURES}
    for pose in procedural.viewmats(24)[::3]:
        view = render(still_life.solids(), white, K, torch.from_numpy(pose), width, height, 1)
        assert view.min() > 0.5


Textures = dict[str, Pyramid]

W, H, F = 80, 60, 70.0


@pytest.fixture(name="K")
def intrinsics() -> torch.Tensor:
    return torch.tensor([[F, 0, W / 2 + 1.5], [0, F, H / 2 - 2.0], [0, 0, 1]])


@pytest.fixture
def ramps() -> dict[str, list[torch.Tensor]]:
    """Red is the texture coordinate a, green is b, so that a colour says which point is shown."""
    t = (torch.arange(64) + 0.5) / 64
    a, b = torch.meshgrid(t, t, indexing="xy")
    ones = torch.ones(3, 64, 64)
    return {"ramp": pyramid(torch.stack([a, b, torch.ones(64, 64)])), "white": pyramid(ones)}


def texture_coordinates(image: torch.Tensor) -> torch.Tensor:
    """(a, b) [H, W, 2] of pixels that show a ramp: the blue channel is the shade alone."""
    return image[..., :2] / image[..., 2:]


def project(points: torch.Tensor, K: torch.Tensor, viewmat: torch.Tensor) -> torch.Tensor:
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = camera @ K.T
    return pixels[..., :2] / pixels[..., 2:]


def turned(degrees: float) -> torch.Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, 0, s, 0.2], [0, 1, 0, -0.1], [-s, 0, c, 0.3], [0, 0, 0, 1.0]])


@pytest.mark.parametrize("supersample", [1, 3])
def test_a_slanted_plane_is_seen_where_its_points_project(
    K: torch.Tensor, ramps: Textures, supersample: int
) -> None:
    quad = Quad("ramp", *torch.tensor([[-1.2, -0.9, 3.0], [2.0, 0.3, 1.5], [0.2, 1.8, -0.4]]))
    image = render([quad], ramps, K, turned(12), W, H, supersample)
    ab = texture_coordinates(image)
    inner = ((ab > 0.05) & (ab < 0.95)).all(-1) & (image[..., 2] > 0)
    assert inner.sum() > 600
    seen = quad.corner + ab[..., :1] * quad.u + ab[..., 1:] * quad.v
    y, x = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    error = project(seen, K, turned(12)) - torch.stack([x, y], -1)
    # A pixel of several samples sees their mean place, which perspective moves by < 0.01 px here.
    assert error[inner].abs().max() < (2e-3 if supersample == 1 else 1e-2)


def test_a_ball_has_the_silhouette_of_its_tangent_cone(K: torch.Tensor, ramps: Textures) -> None:
    depth, radius = 4.0, 0.9
    axis = torch.tensor([0.0, 0.0, depth])
    image = render([Ball("white", axis, radius)], ramps, K, torch.eye(4), W, H, 4)
    area = float(
        (image[..., 0] > 0).float().mul(image[..., 0] / image[..., 0].clamp(min=0.6)).sum()
    )
    covered = float((image.sum(-1) > 0).sum())
    expected = math.pi * (F * radius / math.sqrt(depth**2 - radius**2)) ** 2
    assert area < covered
    # Between the pixels fully inside and all that are touched lies the true disc.
    rim = 2 * math.pi * math.sqrt(expected / math.pi)
    assert covered - 1.5 * rim < expected < covered


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_solid_hides_the_farther_whatever_their_order(
    K: torch.Tensor, ramps: Textures, order: int
) -> None:
    u, v = torch.tensor([8.0, 0, 0]), torch.tensor([0, 8.0, 0])
    near = Quad("ramp", torch.tensor([-4.0, -4.0, 3.0]), u, v)
    far = Quad("white", torch.tensor([-4.0, -4.0, 5.0]), u, v)
    image = render([near, far][::order], ramps, K, torch.eye(4), W, H, 1)
    alone = render([near], ramps, K, torch.eye(4), W, H, 1)
    assert torch.equal(image, alone)
