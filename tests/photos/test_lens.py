"""Cameras against pycolmap's own projection, and undistortion against where rays project."""

from __future__ import annotations

import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.photos.lens import MODELS, Lens, lens_of_model, quarter_turn, undistort

W, H = 100, 80
SERVED = [name for name in MODELS if name != "EQUIRECTANGULAR"]
#: Terms of distortion of real lenses: what beside 0 to 0.02 each model needs or takes.
TERMS = {
    "SIMPLE_RADIAL": (-0.2,),
    "RADIAL": (-0.2, 0.05),
    "OPENCV": (-0.1, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (0.3, 0.1, 0.001, -0.001, 0.02, 0.4, 0.1, 0.02),
    "FOV": (0.9,),
    "SIMPLE_DIVISION": (-0.2,),
    "DIVISION": (0.1,),
    "EUCM": (0.6, 1.1),
}


def camera(model: str, terms: tuple[float, ...] | None = None, f: float = 60.0) -> pycolmap.Camera:
    names = MODELS[model]
    focal = (f, 0.98 * f) if names[0] == "fx" else (f,)
    count = len(names) - len(focal) - 2
    terms = TERMS.get(model, (0.01, -0.004, 0.002, 0.001) * 3)[:count] if terms is None else terms
    return pycolmap.Camera(model=model, width=W, height=H, params=[*focal, 48.0, 41.0, *terms])


def lens_of(cam: pycolmap.Camera) -> Lens:
    return lens_of_model(cam.model_name, (cam.width, cam.height), [float(p) for p in cam.params])


def simple(k: float) -> Lens:
    return lens_of_model("SIMPLE_RADIAL", (W, H), [90.0, 48.0, 41.0, k])


def pixel_grid(width: int = W, height: int = H) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], -1)


def border() -> NDArray[np.float64]:
    t = np.linspace(0, 1, 1001)
    sides = ((t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t))
    return np.concatenate([np.stack(p, -1) for p in sides]) * (W, H)


def test_the_table_of_models_is_pycolmaps() -> None:
    members = pycolmap.CameraModelId.__members__
    ids = {name: int(value) for name, value in members.items() if name != "INVALID"}
    assert list(MODELS) == sorted(ids, key=ids.__getitem__)
    assert sorted(ids.values()) == list(range(len(ids)))
    for name, params in MODELS.items():
        made = pycolmap.Camera.create_from_model_name(1, name, 100.0, W, H)
        assert made.params_info.replace(" ", "").split(",") == list(params)


@pytest.mark.parametrize("model", SERVED)
@given(data=st.data())
@settings(max_examples=15)
def test_every_model_projects_as_pycolmap_also_when_resized_and_cropped(
    model: str, data: st.DataObject
) -> None:
    shapes = {"FOV": (0.1, 1.0), "alpha": (0.1, 0.9), "beta": (0.5, 1.5)}
    names = MODELS[model][3 if MODELS[model][0] == "f" else 4 :]
    limits = [shapes.get(name, shapes.get(model, (-0.1, 0.1))) for name in names]
    cam = camera(model, tuple(data.draw(st.floats(*bounds)) for bounds in limits))
    rays = np.array(data.draw(st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 2), min_size=1)))
    width, height = data.draw(st.tuples(st.integers(20, 300), st.integers(20, 300)))
    left, top = data.draw(st.tuples(st.integers(0, 9), st.integers(0, 9)))
    lens = lens_of(cam).resized(width, height).cropped(left, top, width - 10, height - 10)
    expected = cam.img_from_cam(np.c_[rays, np.ones(len(rays))])
    expected = expected * (width / W, height / H) - (left, top)
    assert lens.project(rays) == pytest.approx(expected, abs=1e-4)
    assert (lens.width, lens.height) == (width - 10, height - 10)


@pytest.mark.parametrize(
    ("model", "quarters"), [*((model, 0) for model in SERVED), ("OPENCV", 1), ("OPENCV", 3)]
)
def test_undistortion_reads_each_pixel_where_the_lens_projects_its_ray(
    model: str, quarters: int
) -> None:
    """Red is x and green is y, so that a colour is the source of its pixel."""
    cam = camera(model, f=90.0)
    stored = np.concatenate([pixel_grid() / (W, H), np.zeros((H, W, 1))], -1).astype(np.float32)
    lens, image = lens_of(cam), stored
    if quarters:
        lens, image = lens.turned(quarters), np.ascontiguousarray(np.rot90(stored, -quarters))
    out, K = undistort(image, lens), lens.undistorted().K
    grid = pixel_grid(lens.width, lens.height)
    rays = np.concatenate([grid, np.ones((*grid.shape[:2], 1))], -1) @ np.linalg.inv(K).T
    rays[..., :2] = rays[..., :2] @ quarter_turn(quarters)  # into the axes of the stored pixels
    expected = cam.img_from_cam(rays.reshape(-1, 3)).reshape((*rays.shape[:2], 2))
    inner = (slice(2, -2), slice(2, -2))  # a spline has no more data half a pixel from the border
    assert np.abs(out[..., :2] * (W, H) - expected)[inner].max() < 0.02


@pytest.mark.parametrize("k", [-0.2, -0.02, 0.03, 0.15])
def test_the_undistorted_image_is_zoomed_as_little_as_fills_it(k: float) -> None:
    flat = simple(k).undistorted()
    assert (flat.width, flat.height, flat.is_pinhole) == (W, H, True)
    rays = (border() - (48, 41)) / flat.K[0, 0]
    source = rays * (1 + k * (rays**2).sum(-1, keepdims=True)) * 90 + (48, 41)
    outside = np.maximum(-source, source - (W, H)).max()
    assert -0.01 < outside < 1e-3
    assert (flat.K[0, 0] > 90) == (k > 0)


def test_a_wide_fisheye_keeps_60_degrees_to_each_side() -> None:
    """An equidistant lens that shows 180 degrees across has the focal length w / pi."""
    lens = lens_of_model("SIMPLE_FISHEYE", (200, 200), [200 / np.pi, 100.0, 100.0])
    flat = lens.undistorted()
    assert flat.K[0, 0] == pytest.approx(100 / np.tan(np.radians(60)))
    # Four sectors around the centre: half the integral of the squared radius over the angle.
    azimuth = np.linspace(-np.pi / 4, np.pi / 4, 4001)
    radius = np.arctan(np.tan(np.radians(60)) / np.cos(azimuth)) * 200 / np.pi
    area = 4 * np.trapezoid(radius**2, azimuth) / 2
    assert lens.kept() == pytest.approx(area / 200**2, rel=1e-4)


def test_a_pinhole_photograph_is_returned_as_it_is() -> None:
    image = np.random.default_rng(0).random((40, 60, 3), dtype=np.float32)
    for model, terms in (("PINHOLE", ()), ("OPENCV", (0, 0, 0, 0)), ("DIVISION", (0,))):
        lens = lens_of_model(model, (60, 40), [50.0, 50.0, 30.0, 20.0, *terms])
        assert undistort(image, lens) is image
        assert lens.undistorted() is lens
        assert lens.kept() == 1


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("EQUIRECTANGULAR", (100, 80), "a panorama has no pinhole camera"),
        ("GLASS", (1,), "camera model GLASS: must be one of SIMPLE_PINHOLE, "),
        ("OPENCV", (60, 60, 50, 40), r"it has 4 parameters; 8 are needed \(fx, fy, .*p2\)"),
        ("PINHOLE", (60, -60, 50, 40), "must be above 0"),
        ("PINHOLE", (60, 60, np.nan, 40), "all values finite"),
    ],
)
def test_a_camera_that_is_not_served_is_named(
    model: str, params: tuple[float, ...], message: str
) -> None:
    with pytest.raises(XrgsError, match=message):
        lens_of_model(model, (W, H), params)


def test_a_lens_that_folds_at_every_zoom_is_refused() -> None:
    with pytest.raises(
        XrgsError, match="SIMPLE_RADIAL: it can't be undistorted, because its distortion folds"
    ):
        simple(-500.0).undistorted()


def test_a_strong_barrel_lens_does_not_fold_the_picture() -> None:
    """r + k r³ falls beyond r² = 1/(3 · 0.9): no pixel may come from there."""
    lens = lens_of_model("SIMPLE_RADIAL", (W, H), [60.0, 50.0, 40.0, -0.9])
    f = lens.undistorted().K[0, 0]
    corner = np.array([-50.0, -40.0]) / f
    assert (corner**2).sum() < 1 / (3 * 0.9)
    source = corner * (1 - 0.9 * (corner**2).sum()) * 60 + (50, 40)
    assert (source >= 0).all()
    assert (source <= (W, H)).all()
