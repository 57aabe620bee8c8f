"""The camera model against its formula, and undistortion against where rays project."""

from __future__ import annotations

import numpy as np
import pytest

from xrgs.capture.lens import Lens, undistort


def test_a_lens_keeps_its_rays_when_its_image_is_resized() -> None:
    lens = Lens(100, 80, 90.0, 91.0, 48.0, 41.0, 0.05).resized(20, 16)
    ray = np.array([0.2, -0.3, 1])
    big = Lens(100, 80, 90.0, 91.0, 48.0, 41.0, 0.05).K @ ray
    assert (lens.K @ ray)[:2] * 5 == pytest.approx(big[:2])
    assert lens.k == 0.05


@pytest.mark.parametrize("k", [-0.2, -0.02, 0.03, 0.15])
def test_undistortion_reads_each_pixel_where_the_lens_projects_its_ray(k: float) -> None:
    """Red is x and green is y, so that a colour is the source of its pixel."""
    lens = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, k)
    x, y = np.meshgrid(np.arange(100) + 0.5, np.arange(80) + 0.5)
    image = np.stack([x / 100, y / 80, 0 * x], -1).astype(np.float32)
    out, K = undistort(image, lens), lens.undistorted().K
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]], -1)
    bent = rays * (1 + k * (rays**2).sum(-1, keepdims=True))
    expected = bent * 90 + (48, 41)
    inner = (slice(2, -2), slice(2, -2))  # a spline has no more data half a pixel from the border
    assert np.abs(out[..., :2] * (100, 80) - expected)[inner].max() < 0.02


@pytest.mark.parametrize("k", [-0.2, -0.02, 0.03, 0.15])
def test_the_undistorted_image_is_zoomed_as_little_as_fills_it(k: float) -> None:
    lens = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, k)
    flat = lens.undistorted()
    assert (flat.width, flat.height, flat.k) == (100, 80, 0.0)
    t = np.linspace(0, 1, 1001)
    border = np.concatenate(
        [np.stack(p, -1) for p in ((t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t))]
    )
    rays = (border * (100, 80) - (48, 41)) / flat.fx
    source = rays * (1 + k * (rays**2).sum(-1, keepdims=True)) * 90 + (48, 41)
    outside = np.maximum(-source, source - (100, 80)).max()
    assert -0.01 < outside < 1e-3
    assert (flat.fx > 90) == (k > 0)


def test_a_strong_barrel_lens_does_not_fold_the_picture() -> None:
    """r + k r³ falls beyond r² = 1/(3 · 0.9): no pixel may come from there."""
    lens = Lens(100, 80, 60.0, 60.0, 50.0, 40.0, -0.9)
    flat = lens.undistorted()
    corner = np.array([0.0, 0.0])
    r2 = (((corner - (50, 40)) / flat.fx) ** 2).sum()
    assert r2 < 1 / (3 * 0.9)
    source = corner - (50, 40)
    source = source / flat.fx * (1 - 0.9 * r2) * 60 + (50, 40)
    assert (source >= 0).all()
    assert (source <= (100, 80)).all()


def test_an_image_and_its_resized_copy_are_zoomed_alike() -> None:
    lens = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, -0.1)
    assert lens.resized(20, 16).undistorted().fx * 5 == pytest.approx(lens.undistorted().fx)


def test_a_pinhole_photograph_is_returned_as_it_is() -> None:
    image = np.random.default_rng(0).random((40, 60, 3), dtype=np.float32)
    assert undistort(image, Lens(60, 40, 50.0, 50.0, 30.0, 20.0)) is image


def test_an_image_of_another_size_than_the_lens_is_refused() -> None:
    image = np.zeros((40, 60, 3), np.float32)
    with pytest.raises(ValueError, match=r"image \(40, 60\), lens \(80, 100\)"):
        undistort(image, Lens(100, 80, 90.0, 90.0, 50.0, 40.0))


@pytest.mark.parametrize("k", [-0.2, 0.0, 0.15])
def test_the_distortion_is_that_of_colmaps_simple_radial(k: float) -> None:
    import pycolmap

    colmap = pycolmap.Camera(model="SIMPLE_RADIAL", width=100, height=80, params=[90, 48, 41, k])
    pixels = np.random.default_rng(0).uniform((0, 0), (100, 80), (50, 2))
    zoom = 1.25
    rays = np.c_[(pixels - (48, 41)) / (90 * zoom), np.ones(50)]
    found = Lens(100, 80, 90.0, 90.0, 48.0, 41.0, k).source_pixels(pixels, zoom)
    assert found == pytest.approx(np.array([colmap.img_from_cam(ray) for ray in rays]))
