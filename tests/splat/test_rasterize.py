"""The face: what it takes, and what it says of what it does not take."""

import re

import pytest
import torch

from xrgs.splat.rasterize import rasterize
from xrgs.splat.settings import RasterSettings

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


@pytest.fixture
def draw(make_camera, make_scene):
    camera = make_camera()
    good = make_scene(6, camera, dtype=torch.float32)

    def run(*, sh_degree=3, means2d_offset=None, backend="torch", **change):
        values = ((good | change)[name] for name in NAMES)
        return rasterize(
            *values,
            camera,
            RasterSettings(),
            sh_degree=sh_degree,
            means2d_offset=means2d_offset,
            backend=backend,
        )

    run.scene = good
    return run


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_result(draw, dtype):
    render = draw(**{name: value.to(dtype) for name, value in draw.scene.items()})
    assert render.image.shape == (14, 20, 3)
    assert render.alpha.shape == (14, 20)
    assert render.visible.shape == (6,)
    assert render.image.dtype == render.alpha.dtype == dtype
    assert render.visible.dtype == torch.bool
    assert render.visible.any()
    assert render.evaluations > 0


def test_image_is_not_clamped_above(draw):
    assert draw(sh0=torch.full((6, 1, 3), 50.0)).image.max() > 2


def test_an_offset_of_zero_changes_nothing(draw):
    assert torch.equal(draw(means2d_offset=torch.zeros(6, 2)).image, draw().image)


@pytest.mark.parametrize("name", [*NAMES, "means2d_offset"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_value_that_is_not_finite_is_named(draw, name, bad):
    value = (draw.scene | {"means2d_offset": torch.zeros(6, 2)})[name].clone()
    value.view(-1)[3] = bad
    with pytest.raises(ValueError, match=rf"^{name} has values"):
        draw(**{name: value})


def test_log_scales_that_overflow_are_named(draw):
    with pytest.raises(ValueError, match=r"^scales has values that are not finite"):
        draw(scales=torch.exp(torch.full((6, 3), 100.0)))


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (6, 2)),
        ("means", ()),
        ("quats", (5, 4)),
        ("quats", (6, 3)),
        ("scales", (6,)),
        ("opacities", (6, 1)),
        ("sh0", (6, 3)),
        ("shN", (6, 15)),
        ("shN", (5, 15, 3)),
        ("shN", (6, 15, 4)),
        ("means2d_offset", (6, 3)),
    ],
)
def test_a_wrong_shape_is_named(draw, name, shape):
    with pytest.raises(
        ValueError, match=rf"^{name} must be \[.*, got {re.escape(str(list(shape)))}"
    ):
        draw(**{name: torch.zeros(shape)})


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_type_is_named(draw, name):
    with pytest.raises(ValueError, match=r"must be of the floating type of means"):
        draw(**{name: draw.scene[name].double()})
    with pytest.raises(ValueError, match=r"must be of the floating type of means"):
        draw(**{name: draw.scene[name].long()})


@pytest.mark.parametrize("bad", [-0.1, 1.1])
def test_opacities_out_of_range(draw, bad):
    with pytest.raises(ValueError, match=r"^opacities has values outside"):
        draw(opacities=torch.full((6,), bad))


def test_scales_below_zero(draw):
    with pytest.raises(ValueError, match=r"^scales has values below"):
        draw(scales=-draw.scene["scales"])


@pytest.mark.parametrize("degree", [-1, 4])
def test_sh_degree_out_of_range(draw, degree):
    with pytest.raises(ValueError, match="sh_degree"):
        draw(sh_degree=degree)


def test_sh_degree_above_the_bands_stored(draw):
    with pytest.raises(ValueError, match="sh_degree 2 needs shN"):
        draw(sh_degree=2, shN=torch.zeros(6, 3, 3))


def test_bands_above_the_degree_do_not_show(draw):
    shN = draw.scene["shN"].clone()
    shN[:, 3:] = 9.0
    assert torch.equal(draw(sh_degree=1, shN=shN).image, draw(sh_degree=1).image)
    assert not torch.equal(draw(sh_degree=2, shN=shN).image, draw(sh_degree=1).image)


def test_unknown_backend(draw):
    with pytest.raises(ValueError, match="'cuda'"):
        draw(backend="cuda")
