"""Paths of cameras against closed forms, and LLFF's spiral against LLFF's own formulas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xrgs.errors import XrgsError
from xrgs.splat.cameras import Camera
from xrgs.splat.normalize import camera_positions
from xrgs.viewer import paths
from xrgs.viewer.paths import Poses

Array = NDArray[np.float64]
TARGET = np.array([1.0, -2.0, 0.5])


def looking_at(position: Array, target: Array) -> Array:
    """The viewmat of a camera with z up, by the package's own camera."""
    camera = Camera.look_at(position.tolist(), target.tolist(), width=8, height=6)
    viewmat: Array = camera.viewmat.double().numpy()
    return viewmat


def ring(degrees: Array) -> Poses:
    """Cameras at these azimuths around a point that they look at, with points around it."""
    angles = np.radians(degrees)
    offsets = np.stack([2 * np.cos(angles), 2 * np.sin(angles), 0 * angles + 0.75], 1)
    viewmats = np.stack([looking_at(TARGET + offset, TARGET) for offset in offsets])
    points = TARGET + np.random.default_rng(0).normal(size=(200, 3)) * 0.1
    return Poses(viewmats, viewmats[:1], points)


def facing_one_way() -> Poses:
    """Cameras on a slightly disturbed grid, all with nearly the same direction of view."""
    rng = np.random.default_rng(1)
    places = np.stack(np.meshgrid([-0.3, -0.1, 0.1, 0.3], [-0.2, 0, 0.2]), -1).reshape(-1, 2)
    viewmats = []
    for x, y in places:
        rotation = Rotation.from_euler("xyz", rng.normal(size=3) * 0.03).as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ [x, y, rng.normal() * 0.02]
        viewmats.append(viewmat)
    points = rng.uniform([-1, -1, 2], [1, 1, 6], size=(500, 3))
    return Poses(np.stack(viewmats), np.stack(viewmats[:4]), points)


def azimuths(viewmats: Array) -> Array:
    x, y, _ = (camera_positions(viewmats) - TARGET).T
    degrees: Array = np.degrees(np.arctan2(y, x)) % 360
    return degrees


def test_cameras_around_a_point_look_at_it() -> None:
    assert paths.look_at_point(ring(np.arange(0.0, 360.0, 30.0))) == pytest.approx(TARGET, abs=0.01)
    assert paths.up_direction(ring(np.arange(0.0, 360.0, 30.0))) == pytest.approx(
        [0, 0, 1], abs=1e-6
    )


def test_parallel_cameras_look_at_the_depth_of_the_points() -> None:
    viewmats = np.repeat(np.eye(4)[None], 3, axis=0)
    viewmats[:, 0, 3] = [-1, 0, 1]  # at x = 1, 0, -1
    points = np.array([[0, 0, 3.0], [0, 0, 4.0], [0, 0, 9.0], [0, 0, -50.0]])
    poses = Poses(viewmats, viewmats, points)
    assert paths.look_at_point(poses) == pytest.approx([0, 0, 4])


def test_an_orbit_of_surrounding_cameras_is_a_closed_circle() -> None:
    path = paths.orbit(ring(np.arange(0.0, 360.0, 30.0)), 12)
    offsets = camera_positions(path) - TARGET
    assert np.hypot(offsets[:, 0], offsets[:, 1]) == pytest.approx(2.0, abs=0.02)
    assert offsets[:, 2] == pytest.approx(0.75, abs=0.01)
    steps = np.diff(azimuths(path), append=azimuths(path)[0]) % 360
    assert steps == pytest.approx(30, abs=0.5), "as far from the last to the first as elsewhere"
    forward = -offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    assert path[:, 2, :3] == pytest.approx(forward, abs=0.02)


def test_an_orbit_stays_where_the_scene_was_photographed_from() -> None:
    path = paths.orbit(ring(np.array([350.0, 5.0, 20.0, 30.0])), 40)
    angles = (azimuths(path) + 180) % 360 - 180
    assert angles.min() == pytest.approx(-10, abs=0.5)
    assert angles.max() == pytest.approx(30, abs=0.5)
    assert angles[0] == pytest.approx(10, abs=0.5), "from the middle of the arc"
    assert angles[20] == pytest.approx(10, abs=0.5), "and back"


def outwards(degrees: Array) -> Poses:
    """Cameras on a circle in a room, which look at its walls."""
    angles = np.radians(degrees)
    ways = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    viewmats = np.stack([looking_at(TARGET + w, TARGET + 4 * w) for w in ways])
    return Poses(viewmats, viewmats[:1], np.concatenate([TARGET + 4 * ways, TARGET + 3.8 * ways]))


def on_a_dome(seed: int) -> Poses:
    """Cameras all around an object, at any height above it and at different distances."""
    rng = np.random.default_rng(seed)
    angles, heights = rng.uniform(0, 2 * np.pi, 60), np.radians(rng.uniform(5, 60, 60))
    flat = np.cos(heights)
    ways = np.stack([flat * np.cos(angles), flat * np.sin(angles), np.sin(heights)], 1)
    places = TARGET + ways * rng.uniform(0.8, 1.25, (60, 1))
    viewmats = np.stack([looking_at(p, TARGET + rng.normal(0, 0.05, 3)) for p in places])
    return Poses(viewmats, viewmats[:1], TARGET + rng.normal(0, 0.1, (200, 3)))


@pytest.mark.parametrize(
    ("poses", "path"),
    [
        (ring(np.arange(0.0, 360.0, 10.0)), "orbit"),
        (ring(np.array([350.0, 5.0, 20.0, 30.0])), "orbit"),
        (on_a_dome(0), "orbit"),
        (facing_one_way(), "orbit"),
        (outwards(np.arange(0.0, 360.0, 10.0)), "training"),
        (outwards(np.arange(0.0, 180.0, 10.0)), "training"),
    ],
    ids=["ring", "arc", "dome", "forward", "room", "half-room"],
)
def test_an_orbit_is_the_default_where_the_cameras_see_its_space(poses: Poses, path: str) -> None:
    assert paths.default_path(poses) == path


def test_the_path_along_the_training_cameras_goes_through_some_of_them() -> None:
    poses = outwards(np.arange(0.0, 360.0, 7.5))
    path = paths.through_training_views(poses, 121)
    passed = poses.train[np.linspace(0, 47, 13).round().astype(int)]
    assert path[::10] == pytest.approx(passed, abs=1e-6)  # cameras are float32
    distances = np.linalg.norm(camera_positions(path) - TARGET, axis=1)
    assert (distances > 0.9).all(), "it stays with the cameras"
    few = Poses(poses.train[:2], poses.test, poses.points)
    assert paths.through_training_views(few, 3)[[0, 2]] == pytest.approx(few.train)
    one = Poses(poses.train[:1], poses.test, poses.points)
    assert paths.through_training_views(one, 2) == pytest.approx(one.train.repeat(2, axis=0))


def llffs_spiral(poses: Poses, views: int) -> tuple[Array, Array]:
    """Positions and backward axes of `render_path_spiral`, in LLFF's axes right, up, backward."""
    c2w = np.linalg.inv(poses.train)[:, :3] * np.array([1, -1, -1, 1])  # columns: r, u, b, place

    def normalized(vector: Array) -> Array:
        return np.asarray(vector / np.linalg.norm(vector))

    def view_matrix(back: Array, up: Array, place: Array) -> Array:
        z = normalized(back)
        x = normalized(np.cross(up, z))
        return np.stack([x, normalized(np.cross(z, x)), z, place], 1)

    centre = c2w[:, :, 3].mean(0)
    mean = view_matrix(c2w[:, :, 2].sum(0), c2w[:, :, 1].sum(0), centre)
    up = normalized(c2w[:, :, 1].sum(0))
    depths = (poses.points @ poses.train[:, 2, :3].T + poses.train[:, 2, 3]).ravel()
    close, inf = np.percentile(depths, 0.1) * 0.9, np.percentile(depths, 99.9) * 5.0
    focal = 1 / ((1 - 0.75) / close + 0.75 / inf)
    inside = (c2w[:, :, 3] - centre) @ mean[:, :3]
    radii = np.append(np.percentile(np.abs(inside), 90, 0), 1.0)
    placed, backward = [], []
    for theta in np.linspace(0.0, 2 * np.pi * 2, views + 1)[:-1]:
        turn = np.array([np.cos(theta), -np.sin(theta), -np.sin(theta * 0.5), 1.0]) * radii
        place = mean @ turn
        matrix = view_matrix(place - mean @ np.array([0, 0, -focal, 1.0]), up, place)
        placed.append(place)
        backward.append(matrix[:, :3])
    return np.stack(placed), np.stack(backward)


def test_the_spiral_is_llffs() -> None:
    poses = facing_one_way()
    path = paths.spiral(poses, 30)
    positions, axes = llffs_spiral(poses, 30)
    assert camera_positions(path) == pytest.approx(positions, abs=1e-12)
    ours = path[:, :3, :3].transpose(0, 2, 1) * np.array([1, -1, -1])  # columns: r, u, b
    assert ours == pytest.approx(axes, abs=1e-12)
    with pytest.raises(XrgsError, match=r"path=spiral: .* --path orbit"):
        paths.spiral(ring(np.arange(0.0, 360.0, 30.0)), 4)


def test_the_path_through_test_views_meets_each_of_them() -> None:
    poses = facing_one_way()
    path = paths.through_test_views(poses, 10)  # three steps between two of four
    assert path[::3] == pytest.approx(poses.test, abs=1e-12)
    still = paths.through_test_views(Poses(poses.train, poses.test[:1], poses.points), 3)
    assert (still == poses.test[0]).all()
    two = Poses(poses.train, poses.test[:2], poses.points)
    middle = paths.through_test_views(two, 3)[1]
    first, last = (Rotation.from_matrix(viewmat[:3, :3]) for viewmat in two.test)
    half = Rotation.from_matrix(middle[:3, :3])
    assert (half * first.inv()).magnitude() == pytest.approx((last * half.inv()).magnitude())
    ends = camera_positions(two.test)
    assert camera_positions(middle[None])[0] == pytest.approx(ends.mean(axis=0))


@pytest.mark.parametrize("name", paths.PATHS)
def test_every_camera_of_a_path_is_rigid(name: str) -> None:
    path = paths.PATHS[name](facing_one_way(), 7)
    assert path.shape == (7, 4, 4)
    rotations = path[:, :3, :3]
    unit = np.broadcast_to(np.eye(3), (7, 3, 3))
    assert rotations @ rotations.transpose(0, 2, 1) == pytest.approx(unit, abs=1e-12)
    assert np.linalg.det(rotations) == pytest.approx(1.0)
