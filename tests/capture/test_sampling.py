from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from xrgs.capture import sampling
from xrgs.capture.lens import lens_of_model
from xrgs.capture.sampling import Measures
from xrgs.capture.sfm import Reconstruction
from xrgs.capture.tags import POLICIES
from xrgs.errors import XrgsError


def K_of(fx: float, fy: float) -> NDArray[np.float64]:  # noqa: N802
    return lens_of_model("PINHOLE", (100, 80), (fx, fy, 50.0, 40.0)).K


LENS = lens_of_model("PINHOLE", (100, 80), (90.0, 90.0, 50.0, 40.0))


def column(*depths: float) -> np.ndarray:
    """Points on the optical axis of a camera at the origin."""
    return np.array([[0, 0, depth] for depth in depths], dtype=np.float64)


def test_the_depth_is_the_median_of_the_observed_points() -> None:
    points = column(1, 2, 3, 4, 5, 6, 7, 8, 9, 100, 100, 100)
    own = np.arange(9)
    assert sampling.median_depth(points, np.eye(4), LENS, own) == 5
    moved = np.eye(4)
    moved[2, 3] = 10
    assert sampling.median_depth(points, moved, LENS, own) == 15


@pytest.mark.parametrize(("count", "depth"), [(8, 4), (7, 30)])
def test_eight_observed_points_are_enough_and_seven_are_not(count: int, depth: float) -> None:
    """Eight points at depth 4 are observed, among many at depth 30 inside the image."""
    points = column(*[4.0] * 8, *[30.0] * 20)
    observed = np.arange(count)
    assert sampling.median_depth(points, np.eye(4), LENS, observed) == depth


def test_observed_points_behind_the_camera_do_not_count() -> None:
    points = column(*[5.0] * 8, *[-3.0] * 9, *[30.0] * 40)
    assert sampling.median_depth(points, np.eye(4), LENS, np.arange(17)) == 5
    # Seven of them are in front: fewer than eight, so that all inside the image are taken.
    assert sampling.median_depth(points, np.eye(4), LENS, np.arange(1, 17)) == 30


def test_too_few_observed_points_are_replaced_by_all_inside_the_image() -> None:
    inside, beside = column(2, 4, 6), column(3, 3) + np.array([10, 0, 0])
    points = np.concatenate([inside, beside, column(-5, -5)])
    assert sampling.median_depth(points, np.eye(4), LENS, [3, 4]) == 4
    assert np.isnan(sampling.median_depth(column(-1), np.eye(4), LENS))


def test_a_view_without_points_gets_the_median_of_the_others() -> None:
    points = column(*[4.0] * 10)
    turned_away = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = {0: np.eye(4), 1: np.eye(4), 5: turned_away}
    tracked = {0: np.arange(10), 1: np.arange(10), 5: np.arange(0)}
    model = Reconstruction(
        dict.fromkeys(poses, LENS), poses, points, np.zeros((10, 3), np.uint8), tracked, {}
    )
    assert sampling.median_depths(model) == {0: 4, 1: 4, 5: 4}
    with pytest.raises(XrgsError, match="none of the points is in front of a camera"):
        sampling.median_depths(replace(model, viewmats={5: turned_away}))


def test_the_rate_is_focal_length_over_depth() -> None:
    """300 px at depth 4 are 75 px per unit, and 100 px at depth 2 are 50, which is 2/3 of it."""
    K = {f: K_of(f, f) for f in (100.0, 300.0)}
    rates = [sampling.sampling_rate(K[300.0], 4), sampling.sampling_rate(K[100.0], 2)]
    assert rates == pytest.approx([75, 50])
    assert sampling.relative_to_largest(rates) == pytest.approx([1, 2 / 3])
    assert sampling.sampling_rate(K_of(40, 90), 3) == pytest.approx(20)


def test_a_smaller_copy_has_a_lower_rate_by_its_factor() -> None:
    small = LENS.resized(20, 16)
    assert sampling.sampling_rate(LENS.K, 3) == pytest.approx(
        5 * sampling.sampling_rate(small.K, 3)
    )


def test_distance_and_sampling_rate_can_disagree() -> None:
    """A far telephoto view has the higher sampling rate, a near wide-angle view the closer one."""
    views = [
        Measures((40, 30), K_of(300, 300), 4.0),
        Measures((30, 40), np.full((3, 3), np.nan), np.nan),
        Measures((20, 15), K_of(100, 100), 2.0),
    ]
    relative = {
        name: sampling.relative_to_largest([policy.score(view) for view in views])
        for name, policy in POLICIES.items()
    }
    assert relative["sampling_rate"] == pytest.approx([1, np.nan, 2 / 3], nan_ok=True)
    assert relative["distance"] == pytest.approx([0.5, np.nan, 1], nan_ok=True)
    assert relative["megapixels"] == [1, 1, 0.25]


def test_points_on_the_border_of_the_image_and_close_to_the_camera_count() -> None:
    """Pixels 0 and 100 of 100 are the image's own border; depth is bounded by 0 alone."""
    border = [[-50 / 90, 0, 1], [50 / 90, 0, 1], [0, -40 / 90, 1], [0, 40 / 90, 1]]
    for point in border:
        assert sampling.median_depth(np.array([point]), np.eye(4), LENS) == 1
        assert np.isnan(
            sampling.median_depth(1.02 * np.array([point]) - [0, 0, 0.02], np.eye(4), LENS)
        )
    assert sampling.median_depth(column(0.25, 0.5, 0.75), np.eye(4), LENS) == 0.5


def test_each_view_has_the_depth_of_the_points_that_it_observes() -> None:
    points = column(*[4.0] * 8, *[6.0] * 8, *[9.0] * 40)
    poses = {0: np.eye(4), 3: np.eye(4)}
    observed = {0: np.arange(8), 3: np.arange(8, 16)}
    model = Reconstruction(
        dict.fromkeys(poses, LENS), poses, points, np.zeros((56, 3), np.uint8), observed, {}
    )
    assert sampling.median_depths(model) == {0: 4, 3: 6}
