"""The stereo pair against its published disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from xrgs.config import SceneConf
from xrgs.photos import images, scenes
from xrgs.photos.scenes import motorcycle
from xrgs.photos.scenes.scene import bundled_photograph


def test_the_motorcycle_calibration_fits_its_disparity(
    tmp_path: Path, stereo_scene: SceneConf
) -> None:
    """With depth = baseline f / (disparity + cx_right - cx_left), left pixels reproject right."""
    scene = scenes.resolve(stereo_scene, tmp_path)
    assert list(scene.files) == ["motorcycle_left", "motorcycle_right"]
    assert images.size(next(iter(scene.files.values()))) == (741, 500)
    disparity = np.load(bundled_photograph("motorcycle_disp.npz"))["arr_0"]
    left, right = (images.read(file).mean(-1) for file in scene.files.values())
    Ks, poses = motorcycle.intrinsics(), motorcycle.viewmats()
    rng, differences, shuffled = np.random.default_rng(0), [], []
    for x, y in zip(rng.integers(150, 700, 400), rng.integers(50, 450, 400), strict=True):
        if not np.isfinite(disparity[y, x]):
            continue
        K_left, K_right = Ks["motorcycle_left"], Ks["motorcycle_right"]
        offset = K_right[0, 2] - K_left[0, 2]
        depth = K_left[0, 0] * 193.001 / (disparity[y, x] + offset)
        point = depth * np.linalg.inv(K_left) @ (x, y, 1)
        seen = K_right @ (
            poses["motorcycle_right"][:3, :3] @ point + poses["motorcycle_right"][:3, 3]
        )
        column, row = seen[:2] / seen[2]
        if not 0 <= column < 740:
            continue
        assert row == pytest.approx(y)
        differences.append(abs(left[y, x] - right[y, round(column)]))
        shuffled.append(abs(left[y, x] - right[y, int(rng.integers(0, 740))]))
    assert len(differences) > 200
    assert np.median(differences) < 0.3 * np.median(shuffled)
