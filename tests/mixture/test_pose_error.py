from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.mixture.pose_error import fit_similarity, pose_error


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    proper: np.ndarray = q * np.linalg.det(q)
    return proper


def cameras(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    found = {}
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation(rng), rng.normal(size=3)
        found[f"v{i}"] = matrix
    return found


def moved(
    views: dict[str, np.ndarray], s: float, R: np.ndarray, t: np.ndarray
) -> dict[str, np.ndarray]:
    """The same cameras in a world of other units: x' = s R x + t."""
    changed = {}
    for name, matrix in views.items():
        new = np.eye(4)
        new[:3, :3] = matrix[:3, :3] @ R.T
        new[:3, 3] = s * matrix[:3, 3] - new[:3, :3] @ t
        changed[name] = new
    return changed


@given(st.integers(0, 10_000), st.floats(0.01, 100), st.integers(3, 12))
def test_a_similarity_of_the_world_is_not_an_error(seed: int, scale: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    exact = cameras(rng, count)
    error = pose_error(moved(exact, scale, rotation(rng), rng.normal(size=3)), exact)
    assert max(error.values()) < 1e-6


@given(st.integers(0, 10_000), st.floats(0.01, 100))
def test_the_similarity_of_moved_points_is_fitted(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    R, shift, points = rotation(rng), rng.normal(size=3), rng.normal(size=(7, 3))
    s, Q, t = fit_similarity(points, scale * points @ R.T + shift)
    assert s == pytest.approx(scale)
    assert pytest.approx(R, abs=1e-9) == Q
    assert t == pytest.approx(shift, abs=1e-7)


@given(st.integers(0, 10_000))
def test_mirrored_points_are_fitted_by_a_rotation_and_not_by_a_reflection(seed: int) -> None:
    """No rotation fits better than scipy's, and the scale is that of linear least squares."""
    from scipy.spatial.transform import Rotation

    points = np.random.default_rng(seed).normal(size=(7, 3))
    mirrored = points * (1, 1, -1)
    scale, R, shift = fit_similarity(points, mirrored)
    assert np.linalg.det(R) == pytest.approx(1)
    assert pytest.approx(np.eye(3), abs=1e-9) == R @ R.T
    centred, target = points - points.mean(0), mirrored - mirrored.mean(0)
    expected, _ = Rotation.align_vectors(target, centred)
    assert pytest.approx(expected.as_matrix(), abs=1e-6) == R
    assert scale == pytest.approx((centred @ R.T * target).sum() / (centred**2).sum())
    assert shift == pytest.approx(mirrored.mean(0) - scale * R @ points.mean(0))


def test_one_turned_camera_is_measured_in_degrees() -> None:
    exact = cameras(np.random.default_rng(0), 100)
    c, s = np.cos(np.radians(2)), np.sin(np.radians(2))
    found = {n: m.copy() for n, m in exact.items()}
    centre = -found["v3"][:3, :3].T @ found["v3"][:3, 3]
    found["v3"][:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ found["v3"][:3, :3]
    found["v3"][:3, 3] = -found["v3"][:3, :3] @ centre
    error = pose_error(found, exact)
    assert error["rotation_degrees_max"] == pytest.approx(2, rel=0.02)
    assert error["rotation_degrees"] == pytest.approx(0.04, rel=0.1)
    assert error["position_percent_max"] < 1e-9


def test_one_shifted_camera_is_measured_in_percent_of_the_extent() -> None:
    exact = {}
    for i, x in enumerate(np.linspace(0, 10, 101)):
        matrix = np.eye(4)
        matrix[:3, 3] = -np.array([x, np.sin(i), np.cos(i)])
        exact[f"v{i}"] = matrix
    found = {n: m.copy() for n, m in exact.items()}
    found["v50"][1, 3] += 0.5
    error = pose_error(found, exact)
    assert error["position_percent_max"] == pytest.approx(5, rel=0.05)


def test_two_cameras_have_no_position_error_and_one_none_at_all() -> None:
    exact = cameras(np.random.default_rng(0), 2)
    assert pose_error(exact, exact).keys() == {"rotation_degrees", "rotation_degrees_max"}
    assert pose_error({"v0": exact["v0"], "other": exact["v1"]}, exact) == {}
