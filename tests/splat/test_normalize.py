"""Normalisation of a scene: what it must leave alone, and where cameras and points end up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from xrgs.splat.normalize import (
    camera_positions,
    normalize_scene,
    principal_axes,
    rotation_between,
    similarity_from_cameras,
    transform_points,
    transform_viewmats,
)

Array = NDArray[np.float64]
World = tuple[Array, Array]


def turn(rng: np.random.Generator) -> Array:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation: Array = q * np.linalg.det(q)
    return rotation


def assert_rigid(transforms: Array) -> None:
    """Assert that these matrices [..., 3 or 4, 3 or 4] turn, and neither scale nor mirror."""
    rotation = transforms[..., :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(-1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1)


def similarity(rng: np.random.Generator, scale: float) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn(rng)
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


@pytest.fixture
def world() -> World:
    """Seven cameras that look at a cloud, more or less forward-facing; up is -y, roughly."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(300, 3)) * (2.0, 1.0, 0.3) + (0.5, 0.2, 6.0)
    viewmats = np.tile(np.eye(4), (7, 1, 1))
    for viewmat in viewmats:
        small = rotation_between(
            np.array([0.0, 0, 1]), (d := rng.normal(size=3) * 0.1 + (0, 0, 1)) / np.linalg.norm(d)
        )
        viewmat[:3, :3] = small
        viewmat[:3, 3] = -small @ (rng.normal(size=3) * (1.0, 0.5, 0.2))
    return viewmats, points


def in_cameras(viewmats: Array, points: Array) -> Array:
    """Coordinates of all points in all cameras: [C, P, 3]."""
    coordinates: Array = (
        np.einsum("cij,pj->cpi", viewmats[:, :3, :3], points) + viewmats[:, None, :3, 3]
    )
    return coordinates


def test_what_cameras_see_only_changes_its_scale(world: World) -> None:
    viewmats, points = world
    normalized = normalize_scene(viewmats, points)
    scale = np.cbrt(np.linalg.det(normalized.transform[:3, :3]))
    np.testing.assert_allclose(
        in_cameras(normalized.viewmats, normalized.points),
        scale * in_cameras(viewmats, points),
        atol=1e-10,
    )
    assert_rigid(normalized.viewmats)
    np.testing.assert_allclose(
        transform_points(normalized.transform, points), normalized.points, atol=1e-12
    )
    positions = [-v[:3, :3].T @ v[:3, 3] for v in normalized.viewmats]
    extent = max(np.linalg.norm(p - np.mean(positions, axis=0)) for p in positions)
    assert normalized.scene_scale == pytest.approx(1.1 * extent)


def test_similarity_turns_up_and_puts_the_median_camera_at_one(world: World) -> None:
    viewmats, _ = world
    moved = transform_viewmats(similarity_from_cameras(viewmats), viewmats)
    up = -moved[:, 1, :3].mean(0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, -1, 0], atol=1e-12)
    assert np.median(np.linalg.norm(camera_positions(moved), axis=1)) == pytest.approx(1)


def test_focus_and_scale_are_medians() -> None:
    """Cameras in a row, two units behind the origin, that look along z; one stands far off."""
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 0, 3] = (0.0, -1.0, -10.0)
    viewmats[:, 2, 3] = 2.0
    expected = np.eye(4) / np.sqrt(5)
    expected[0, 3] = -1 / np.sqrt(5)
    expected[3, 3] = 1
    np.testing.assert_allclose(similarity_from_cameras(viewmats), expected, atol=1e-12)


def test_points_end_on_their_principal_axes(world: World) -> None:
    points = normalize_scene(*world).points
    np.testing.assert_allclose(np.median(points, axis=0), 0, atol=0.2)
    covariance = np.cov(points, rowvar=False)
    np.testing.assert_allclose(covariance - np.diag(np.diag(covariance)), 0, atol=1e-12)
    assert (np.diff(np.diag(covariance)) < 0).all(), "x the widest, z the thinnest"


def test_principal_axes_are_a_rigid_motion_of_the_median_to_zero() -> None:
    for seed in range(6):  # eigenvectors of either orientation
        rng = np.random.default_rng(seed)
        points = (rng.normal(size=(50, 3)) * (3, 2, 1)) @ turn(rng).T + rng.normal(size=3)
        transform = principal_axes(points)
        assert_rigid(transform)
        median = transform_points(transform, np.median(points, axis=0)[None])
        np.testing.assert_allclose(median, [[0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_any_world_is_normalised_to_a_similar_one(world: World, seed: int) -> None:
    """Whatever similarity the world came by, only the size of what is seen may differ."""
    viewmats, points = world
    matrix = similarity(np.random.default_rng(seed), scale=3.0)
    ours = normalize_scene(transform_viewmats(matrix, viewmats), transform_points(matrix, points))
    theirs = normalize_scene(viewmats, points)
    ratio = ours.scene_scale / theirs.scene_scale
    np.testing.assert_allclose(
        in_cameras(ours.viewmats, ours.points),
        ratio * in_cameras(theirs.viewmats, theirs.points),
        atol=1e-8,
    )


def test_rotation_between() -> None:
    rng = np.random.default_rng(0)
    start, end = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    for target in (end, start, -start):
        rotation = rotation_between(start, target)
        np.testing.assert_allclose(rotation @ start, target, atol=1e-12)
        assert_rigid(rotation)


def test_one_camera_on_its_own_focus_keeps_the_scale(world: World) -> None:
    """One camera and three points are enough."""
    normalized = normalize_scene(np.eye(4)[None], world[1][:3])
    assert np.isfinite(normalized.points).all()
    assert np.linalg.det(normalized.transform[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": np.zeros((0, 4, 4))}, "0 viewmats"),
        ({"points": np.zeros((2, 3))}, "2 points"),
        ({"points": np.zeros((5, 2))}, "points must be finite"),
        ({"viewmats": np.zeros((5, 3, 4))}, "viewmats must be finite"),
        ({"points": np.full((5, 3), np.nan)}, "points must be finite"),
    ],
)
def test_bad_input_is_named(world: World, change: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        normalize_scene(**({"viewmats": world[0], "points": world[1]} | change))
