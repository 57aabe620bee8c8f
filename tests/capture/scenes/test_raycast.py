"""The ray-caster against closed forms: where a camera must see what."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from xrgs.capture.scenes import procedural, still_life
from xrgs.capture.scenes.raycast import Ball, Quad, pyramid, render

W, H, F = 80, 60, 70.0


@pytest.fixture(name="K")
def intrinsics() -> torch.Tensor:
    return torch.tensor([[F, 0, W / 2 + 1.5], [0, F, H / 2 - 2.0], [0, 0, 1]])


@pytest.fixture
def ramps() -> dict[str, list[torch.Tensor]]:
    """Red is the texture's a, green its b: a pixel tells which point of the solid it sees."""
    t = (torch.arange(64) + 0.5) / 64
    a, b = torch.meshgrid(t, t, indexing="xy")
    ones = torch.ones(3, 64, 64)
    return {"ramp": pyramid(torch.stack([a, b, torch.ones(64, 64)])), "white": pyramid(ones)}


def place(image: torch.Tensor) -> torch.Tensor:
    """(a, b) [H, W, 2] that a ramp's pixels saw: the blue channel holds the shade alone."""
    return image[..., :2] / image[..., 2:]


def project(points: torch.Tensor, K: torch.Tensor, viewmat: torch.Tensor) -> torch.Tensor:
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = camera @ K.T
    return pixels[..., :2] / pixels[..., 2:]


def turned(degrees: float) -> torch.Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, 0, s, 0.2], [0, 1, 0, -0.1], [-s, 0, c, 0.3], [0, 0, 0, 1.0]])


@pytest.mark.parametrize("supersample", [1, 3])
def test_a_slanted_plane_is_seen_where_its_points_project(K, ramps, supersample) -> None:
    quad = Quad("ramp", *torch.tensor([[-1.2, -0.9, 3.0], [2.0, 0.3, 1.5], [0.2, 1.8, -0.4]]))
    image = render([quad], ramps, K, turned(12), W, H, supersample)
    ab = place(image)
    inner = ((ab > 0.05) & (ab < 0.95)).all(-1) & (image[..., 2] > 0)
    assert inner.sum() > 600
    seen = quad.corner + ab[..., :1] * quad.u + ab[..., 1:] * quad.v
    y, x = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    error = project(seen, K, turned(12)) - torch.stack([x, y], -1)
    # A pixel of several samples sees their mean place, which perspective moves by < 0.01 px here.
    assert error[inner].abs().max() < (2e-3 if supersample == 1 else 1e-2)


def test_a_ball_has_the_silhouette_of_its_tangent_cone(K, ramps) -> None:
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


def test_a_balls_texture_is_centred_on_the_side_that_faces_the_cameras(ramps) -> None:
    K = torch.tensor([[F, 0, 40.5], [0, F, 30.5], [0, 0, 1]])
    ball = Ball("ramp", torch.tensor([0.0, 0.0, 4.0]), 0.9)
    ab = place(render([ball], ramps, K, torch.eye(4), W, H, 1))
    assert ab[30, 40].tolist() == pytest.approx([0.5, 0.5], abs=1e-3)
    assert ab[30, 45, 0] > 0.52  # a grows to the right
    assert ab[35, 40, 1] > 0.52  # b grows downwards


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_solid_hides_the_farther_whatever_their_order(K, ramps, order) -> None:
    u, v = torch.tensor([8.0, 0, 0]), torch.tensor([0, 8.0, 0])
    near = Quad("ramp", torch.tensor([-4.0, -4.0, 3.0]), u, v)
    far = Quad("white", torch.tensor([-4.0, -4.0, 5.0]), u, v)
    image = render([near, far][::order], ramps, K, torch.eye(4), W, H, 1)
    alone = render([near], ramps, K, torch.eye(4), W, H, 1)
    assert torch.equal(image, alone)


def test_what_is_behind_the_camera_is_not_seen(K, ramps) -> None:
    u, v = torch.tensor([8.0, 0, 0]), torch.tensor([0, 8.0, 0])
    behind = Quad("white", torch.tensor([-4.0, -4.0, -3.0]), u, v)
    assert render([behind], ramps, K, torch.eye(4), W, H, 1).max() == 0


def test_a_third_covered_pixel_is_a_third_bright(ramps) -> None:
    K = torch.tensor([[F, 0, 40.0], [0, F, 30.0], [0, 0, 1]])
    # At z = F a unit is a pixel: the sheet ends a third into the pixel of column 50.
    u, v = torch.tensor([10.0 + 1 / 3, 0, 0]), torch.tensor([0, 40.0, 0])
    sheet = Quad("white", torch.tensor([0.0, -20.0, F]), u, v)
    row = render([sheet], ramps, K, torch.eye(4), W, H, 3)[30, :, 0]
    full = row[45]
    assert full > 0.5
    assert row[50] / full == pytest.approx(1 / 3, abs=1e-5)
    assert row[51] == 0
    assert row[39] == 0


def test_supersampling_converges_to_the_area_average(K, ramps) -> None:
    """A fine checker far away: few samples alias, many agree with the texture's mean."""
    checker = (torch.arange(64)[:, None] + torch.arange(64)) % 2
    skins = {"checker": pyramid(checker.float().expand(3, 64, 64).clone())}
    u, v = torch.tensor([6.0, 0, 0]), torch.tensor([0, 6.0, 0])
    sheet = Quad("checker", torch.tensor([-3.0, -3.0, 12.0]), u, v)
    flat = Quad("white", torch.tensor([-3.0, -3.0, 12.0]), u, v)
    seen = render([sheet], skins, K, torch.eye(4), W, H, 3)
    white = render([flat], ramps, K, torch.eye(4), W, H, 3)
    inside = white > 0.99 * white.max()
    ratio = (seen / white.clamp(min=1e-6))[inside]
    assert ratio.mean() == pytest.approx(0.5, abs=0.01)
    assert ratio.std() < 0.05


@pytest.fixture(scope="module")
def poses() -> NDArray[np.float64]:
    return procedural.viewmats(24)


def test_the_embedded_scenes_cameras_are_rigid_and_face_forward(poses) -> None:
    rotation = poses[:, :3, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(np.ones(24))
    assert (rotation[:, 2, 2] > 0.9).all()


def test_held_out_views_are_spread_among_the_others(poses) -> None:
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    train = np.delete(centres, [0, 8, 16], axis=0)
    for test in centres[[0, 8, 16]]:
        assert (train.min(0)[:2] < test[:2]).all()
        assert (test[:2] < train.max(0)[:2]).all()


def test_every_pixel_of_the_embedded_scene_sees_something(poses) -> None:
    width, height = procedural.camera_size(64)
    K = torch.from_numpy(procedural.intrinsics(width, height))
    white = {name: pyramid(torch.ones(3, 4, 4)) for name in procedural.TEXTURES}
    for pose in poses[::3]:
        view = render(still_life.solids(), white, K, torch.from_numpy(pose), width, height, 1)
        assert view.min() > 0.5
