"""Gaussians on SfM points, against the start of gsplat's trainer worked out in numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from xrgs.splat.gaussians import MIN_SPACING, PARAMETERS, Gaussians
from xrgs.splat.sh import sh_to_colors

Cloud = tuple[NDArray[np.float64], NDArray[np.uint8]]


@pytest.fixture
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    return rng.normal(size=(30, 3)), rng.integers(0, 256, (30, 3), dtype=np.uint8)


def start(points: Any, colors: Any, **options: Any) -> Gaussians:
    options = {"init_opacity": 0.1, "sh_degree": 3, **options}
    generator = torch.Generator().manual_seed(0)
    return Gaussians.from_points(points, colors, generator=generator, **options)


def test_start_is_gsplats(cloud: Cloud) -> None:
    points, colors = cloud
    gaussians = start(points, colors)
    assert len(gaussians) == 30
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    expected = np.sqrt((nearest**2).mean(axis=1))
    means, quats, scales, opacities, sh0, shN = gaussians.activated()
    np.testing.assert_allclose(means.detach(), points, rtol=1e-6)
    np.testing.assert_allclose(scales.detach(), np.repeat(expected[:, None], 3, 1), rtol=1e-5)
    np.testing.assert_allclose(opacities.detach(), 0.1, rtol=1e-5)
    assert ((quats >= 0) & (quats < 1)).all()
    assert not shN.requires_grad  # the optimizer has its gradient from sh0's
    dirs = torch.nn.functional.normalize(means, dim=-1)
    np.testing.assert_allclose(sh_to_colors(3, dirs, sh0, shN).detach(), colors / 255.0, atol=1e-6)


def test_the_factor_of_the_scales_changes_nothing_else(cloud: Cloud) -> None:
    whole, tenth = start(*cloud), start(*cloud, init_scale=0.1)
    torch.testing.assert_close(tenth.scales, whole.scales + np.log(0.1), rtol=0, atol=1e-6)
    for name in set(PARAMETERS) - {"scales"}:
        assert torch.equal(tenth[name], whole[name])
    for wrong in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match=r"^init_scale must be finite and above 0"):
            start(*cloud, init_scale=wrong)


def test_float_colors_are_as_8_bit_ones(cloud: Cloud) -> None:
    points, colors = cloud
    floats = start(points, torch.from_numpy(colors).double() / 255, sh_degree=1)
    torch.testing.assert_close(floats.sh0, start(points, colors).sh0)
    assert floats.shN.shape == (30, 3, 3)


def test_points_on_one_another_have_a_finite_scale(cloud: Cloud) -> None:
    _, colors = cloud
    gaussians = start(np.zeros((30, 3)), colors)
    torch.testing.assert_close(torch.exp(gaussians.scales), torch.full((30, 3), MIN_SPACING))


def test_the_callers_points_are_not_shared_and_four_are_enough() -> None:
    points = torch.randn(4, 3)
    gaussians = start(points, torch.rand(4, 3))
    before = gaussians.means.detach().clone()
    points += 1
    assert torch.equal(gaussians.means, before)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((30, 2))}, "points and colors"),
        ({"colors": np.zeros((29, 3), np.uint8)}, "points and colors"),
        ({"points": np.zeros((3, 3)), "colors": np.zeros((3, 3), np.uint8)}, "at least 4"),
        ({"points": np.full((30, 3), np.nan)}, "points has values"),
        ({"colors": np.full((30, 3), np.inf)}, "colors has values"),
        ({"init_opacity": 1.0}, "init_opacity"),
        ({"init_opacity": 0.0}, "init_opacity"),
        ({"sh_degree": 4}, "sh_degree must be 0 to 3, got 4"),
        ({"sh_degree": -1}, "sh_degree must be 0 to 3, got -1"),
    ],
)
def test_bad_input_is_named(cloud: Cloud, change: Any, message: str) -> None:
    points, colors = cloud
    with pytest.raises(ValueError, match=message):
        start(**({"points": points, "colors": colors} | change))
