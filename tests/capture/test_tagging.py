from __future__ import annotations

import numpy as np
import pytest

from xrgs.capture import tagging
from xrgs.capture.images import Lens
from xrgs.capture.sfm import Reconstruction

LENS = Lens(100, 80, 90.0, 90.0, 50.0, 40.0)


def column(*depths: float) -> np.ndarray:
    """Points on the optical axis of a camera at the origin."""
    return np.array([[0, 0, depth] for depth in depths], dtype=np.float64)


def test_the_depth_is_the_median_of_the_points_found_in_the_view() -> None:
    points = column(1, 2, 3, 4, 5, 6, 7, 8, 9, 100, 100, 100)
    own = np.arange(9)
    assert tagging.median_depth(points, np.eye(4), LENS, own) == 5
    moved = np.eye(4)
    moved[2, 3] = 10
    assert tagging.median_depth(points, moved, LENS, own) == 15


def test_few_points_of_its_own_give_way_to_all_inside_the_image() -> None:
    inside, beside = column(2, 4, 6), column(3, 3) + np.array([10, 0, 0])
    points = np.concatenate([inside, beside, column(-5, -5)])
    assert tagging.median_depth(points, np.eye(4), LENS, [3, 4]) == 4
    assert np.isnan(tagging.median_depth(column(-1), np.eye(4), LENS))


def test_a_view_that_sees_nothing_is_as_deep_as_the_others() -> None:
    points = column(*[4.0] * 10)
    away = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = {0: np.eye(4), 1: np.eye(4), 5: away}
    tracked = {0: np.arange(10), 1: np.arange(10), 5: np.arange(0)}
    model = Reconstruction(
        dict.fromkeys(poses, LENS), poses, points, np.zeros((10, 3), np.uint8), tracked, {}
    )
    assert tagging.depths(model) == {0: 4, 1: 4, 5: 4}


def test_the_rate_is_focal_length_over_depth() -> None:
    """Two cameras: 300 px at 4 has 75 px a unit, 100 px at 2 has 50: 2/3 of it."""
    K = {f: Lens(100, 80, f, f, 50, 40).K for f in (100.0, 300.0)}
    rates = [tagging.rate(K[300.0], 4), tagging.rate(K[100.0], 2)]
    assert rates == pytest.approx([75, 50])
    assert tagging.of_best(rates) == pytest.approx([1, 2 / 3])
    assert tagging.rate(Lens(100, 80, 40, 90, 50, 40).K, 3) == pytest.approx(20)


def test_a_smaller_copy_has_a_lower_rate_by_its_factor() -> None:
    small = LENS.at(20, 16)
    assert tagging.rate(LENS.K, 3) == pytest.approx(5 * tagging.rate(small.K, 3))


def test_each_policy_measures_its_own_thing() -> None:
    """A far tele lens resolves more than a near wide one, which is the closer of the two."""
    lenses = {0: Lens(100, 80, 300, 300, 50, 40), 2: Lens(100, 80, 100, 100, 50, 40)}
    depth = {0: 4.0, 2: 2.0}
    by_rate = tagging.by_depth("sampling_rate", 3, lenses, depth)
    by_distance = tagging.by_depth("distance", 3, lenses, depth)
    assert by_rate == pytest.approx([1, np.nan, 2 / 3], nan_ok=True)
    assert by_distance == pytest.approx([0.5, np.nan, 1], nan_ok=True)
    assert tagging.megapixels([(40, 30), (30, 40), (20, 15)]) == [1, 1, 0.25]
