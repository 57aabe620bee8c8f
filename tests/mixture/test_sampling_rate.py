from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.mixture import sampling_rate
from xrgs.mixture.sampling_rate import Measures
from xrgs.mixture.tags import POLICIES
from xrgs.mixture.views import Reconstruction
from xrgs.photos.lens import lens_of_model


def K_of(fx: float, fy: float) -> NDArray[np.float64]:  # noqa: N802
    return lens_of_model("PINHOLE", (100, 80), (fx, fy, 50.0, 40.0)).K


LENS = lens_of_model("PINHOLE", (100, 80), (90.0, 90.0, 50.0, 40.0))


def column(*depths: float) -> np.ndarray:
    """Points on the optical axis of a camera at the origin."""
    return np.array([[0, 0, depth] for depth in depths], dtype=np.float64)


@pytest.mark.parametrize(("count", "depth"), [(8, 4), (7, 30)])
def test_eight_observed_points_are_enough_and_seven_are_not(count: int, depth: float) -> None:
    """Eight points at depth 4 are observed, among many at depth 30 inside the image."""
    points = column(*[4.0] * 8, *[30.0] * 20)
    observed = np.arange(count)
    assert sampling_rate.median_depth(points, np.eye(4), LENS, observed) == depth


def test_observed_points_behind_the_camera_do_not_count() -> None:
    points = column(*[5.0] * 8, *[-3.0] * 9, *[30.0] * 40)
    assert sampling_rate.median_depth(points, np.eye(4), LENS, np.arange(17)) == 5
    # Seven of them are in front: fewer than eight, so that all inside the image are taken.
    assert sampling_rate.median_depth(points, np.eye(4), LENS, np.arange(1, 17)) == 30


def test_too_few_observed_points_are_replaced_by_all_inside_the_image() -> None:
    inside, beside = column(2, 4, 6), column(3, 3) + np.array([10, 0, 0])
    points = np.concatenate([inside, beside, column(-5, -5)])
    assert sampling_rate.median_depth(points, np.eye(4), LENS, [3, 4]) == 4
    assert np.isnan(sampling_rate.median_depth(column(-1), np.eye(4), LENS))


def test_a_view_without_points_gets_the_median_of_the_others() -> None:
    points = column(*[4.0] * 10)
    turned_away = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = {0: np.eye(4), 1: np.eye(4), 5: turned_away}
    tracked = {0: np.arange(10), 1: np.arange(10), 5: np.arange(0)}
    model = Reconstruction(
        dict.fromkeys(poses, LENS), poses, points, np.zeros((10, 3), np.uint8), tracked, {}
    )
    assert sampling_rate.median_depths(model) == {0: 4, 1: 4, 5: 4}
    with pytest.raises(XrgsError, match="none of the points is in front of a camera"):
        sampling_rate.median_depths(replace(model, viewmats={5: turned_away}))


def test_distance_and_sampling_rate_can_disagree() -> None:
    """A far telephoto view has the higher sampling rate, a near wide-angle view the closer one."""
    views = [
        Measures((40, 30), K_of(300, 300), 4.0),
        Measures((30, 40), np.full((3, 3), np.nan), np.nan),
        Measures((20, 15), K_of(100, 100), 2.0),
    ]
    relative = {
        name: sampling_rate.relative_to_largest([policy.score(view) for view in views])
        for name, policy in POLICIES.items()
    }
    assert relative["sampling_rate"] == pytest.approx([1, np.nan, 2 / 3], nan_ok=True)
    assert relative["distance"] == pytest.approx([0.5, np.nan, 1], nan_ok=True)
    assert relative["megapixels"] == [1, 1, 0.25]


def rates_of(*cameras: tuple[float, float], points: np.ndarray) -> np.ndarray:
    """Rates [V, P] of views along the z axis, by (focal length, z of the camera)."""
    rates = []
    for focal, place in cameras:
        viewmat = np.eye(4)
        viewmat[2, 3] = -place
        rates.append(sampling_rate.point_rates(points, viewmat, K_of(focal, focal), (100, 80)))
    return np.stack(rates)


def test_the_rate_at_a_point_is_focal_length_over_its_depth() -> None:
    """An anisotropic camera has the geometric mean of its focal lengths."""
    points = column(2, 5, -1)
    moved = np.eye(4)
    moved[2, 3] = 3
    rates = sampling_rate.point_rates(points, moved, K_of(40, 90), (100, 80))
    assert rates.tolist() == pytest.approx([60 / 5, 60 / 8, 60 / 2])
    assert sampling_rate.point_rates(points, np.eye(4), K_of(40, 90), (100, 80))[2] == 0


def test_a_view_sees_what_is_inside_its_image_and_its_mask() -> None:
    """At depth 1 the 100 x 80 px of 90 px focal length show 5/9 and 4/9 to each side."""
    points = np.array([[-0.55, 0, 1], [0.55, 0, 1], [0, 0.44, 1], [0.56, 0, 1], [0, -0.45, 1]])
    seen = sampling_rate.point_rates(points, np.eye(4), LENS.K, (100, 80)) > 0
    assert seen.tolist() == [True, True, True, False, False]
    used = np.ones((80, 100), dtype=bool)
    used[40, 0] = False  # the pixel of the first point
    seen = sampling_rate.point_rates(points, np.eye(4), LENS.K, (100, 80), used) > 0
    assert seen.tolist() == [False, True, True, False, False]


def test_a_view_needs_the_ratio_of_the_rates_at_the_points_that_it_shares() -> None:
    """Of a plane at depth 4: 100 px are 25 px per unit, 300 px are 75, and from depth 2 are 150."""
    plane = np.array([[x, y, 4.0] for x in (-0.1, 0, 0.1) for y in (-0.1, 0, 0.1)])
    rates = rates_of((100, 0), (300, 0), (300, 2), points=plane)
    trained = np.ones(3, dtype=bool)
    assert sampling_rate.needed_factors(rates, trained) == pytest.approx([6, 2, 1])
    # Test views are measured against training views, and are no reason for more px.
    assert sampling_rate.needed_factors(rates, np.array([True, True, False])) == pytest.approx(
        [3, 1, 0.5]
    )


def test_a_view_that_alone_sees_its_points_needs_nothing_whatever_its_rate() -> None:
    """Global rates differ by 10, but no point is seen by both views; rho alone can't tell."""
    apart = np.array([[10.0, 10.0, 0, 0], [0, 0, 1.0, 1.0]])
    assert sampling_rate.needed_factors(apart, np.ones(2, dtype=bool)) == [1, 1]
    # Two thirds of the coarse view's points are shown ten times as finely.
    shared = np.array([[10.0, 10.0, 0.0], [1.0, 1.0, 1.0]])
    assert sampling_rate.needed_factors(shared, np.ones(2, dtype=bool)) == [1, 10]
    unseen = np.array([[10.0, 10.0], [0.0, 0.0]])
    assert sampling_rate.needed_factors(unseen, np.ones(2, dtype=bool)) == [1, 1]


@pytest.mark.parametrize(("fine", "need"), [(0, 1), (1, 1), (3, 1), (4, 8), (12, 8)])
def test_a_tenth_of_the_views_makes_the_finest_rate(fine: int, need: float) -> None:
    rates = np.array([8.0] * fine + [1.0] * (40 - fine))[:, None] * np.ones(5)
    assert sampling_rate.needed_factors(rates, np.ones(40, dtype=bool))[-1] == need


def test_the_depth_is_the_median_of_the_observed_points() -> None:
    points = column(1, 2, 3, 4, 5, 6, 7, 8, 9, 100, 100, 100)
    own = np.arange(9)
    assert sampling_rate.median_depth(points, np.eye(4), LENS, own) == 5
    moved = np.eye(4)
    moved[2, 3] = 10
    assert sampling_rate.median_depth(points, moved, LENS, own) == 15


def test_points_on_the_border_of_the_image_and_close_to_the_camera_count() -> None:
    """Pixels 0 and 100 of 100 are the image's own border; depth is bounded by 0 alone."""
    border = [[-50 / 90, 0, 1], [50 / 90, 0, 1], [0, -40 / 90, 1], [0, 40 / 90, 1]]
    for point in border:
        assert sampling_rate.median_depth(np.array([point]), np.eye(4), LENS) == 1
        assert np.isnan(
            sampling_rate.median_depth(1.02 * np.array([point]) - [0, 0, 0.02], np.eye(4), LENS)
        )
    assert sampling_rate.median_depth(column(0.25, 0.5, 0.75), np.eye(4), LENS) == 0.5
