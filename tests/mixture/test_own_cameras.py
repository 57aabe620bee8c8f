"""Views that were cropped, found in models of COLMAP's synthetic scenes."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
import pytest

from xrgs.mixture import sfm


def cropped(factor: float, odd: Sequence[int]) -> tuple[Any, dict[str, tuple[int, str]]]:
    """A model of ten views with one camera, of which some were enlarged about their centre."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 10, 300
    options.camera_width, options.camera_height = 500, 375
    options.camera_params = [450.0, 250.0, 187.5, 0.02]
    pycolmap.set_random_seed(0)
    model, rng = pycolmap.synthesize_dataset(options), np.random.default_rng(0)
    views = sorted(model.images.values(), key=lambda view: view.name)
    for number, view in enumerate(views):
        for point in view.points2D:
            scale = factor if number in odd else 1
            point.xy = (point.xy + rng.normal(0, 0.5, 2) - (250, 187.5)) * scale + (250, 187.5)
    adjusted = pycolmap.BundleAdjustmentOptions(print_summary=False)
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.images:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(adjusted, config, model).solve()
    model.update_point_3d_errors()
    return model, {view.name: (i, "one") for i, view in enumerate(views)}


@pytest.mark.parametrize(("factor", "odd"), [(1 / 0.5, (2,)), (1.2, (2, 5, 6)), (0.8, (2,))])
def test_views_that_were_cropped_don_t_share_the_camera(
    factor: float, odd: tuple[int, ...]
) -> None:
    model, given = cropped(factor, odd)
    before = {number: view.cam_from_world().matrix() for number, view in model.images.items()}
    apart = sfm.other_cameras(model, given)
    assert sorted(apart) == list(odd)
    assert len({*apart.values()}) == 1
    assert len(model.cameras) == 1  # the model stays as it is
    for number, view in model.images.items():
        assert np.array_equal(view.cam_from_world().matrix(), before[number])


def test_cameras_that_are_known_or_apart_already_are_not_tried() -> None:
    model, given = cropped(1 / 0.7, (2, 5, 6))
    assert sfm.other_cameras(model, {}) == {}
    own = {name: (i, name) for name, (i, _) in given.items()}
    assert sfm.other_cameras(model, own) == {}


def test_focal_lengths_are_grouped_by_gaps() -> None:
    focals = {0: 100.0, 1: 103.0, 2: 200.0, 3: 101.0, 4: 300.0, 5: 207.0}
    assert sfm.groups_of_focals(focals) == [[0, 3, 1], [2, 5], [4]]
