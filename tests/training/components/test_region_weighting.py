"""Section 7.2: LR views are attenuated where they are textured and an HR view covers them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from xrgs.capture.dataset import Dataset, LoadedView
from xrgs.config import Conf, RegionWeightingConf
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.training import components
from xrgs.training.components import Step
from xrgs.training.components.region_weighting import coverage, region_attenuations

#: The losses of these tests do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)

NEAR = 0.01


def camera(size: int, *, x: float = 0.0, back: float = 0.0, focal: float | None = None) -> Camera:
    """A camera that sees -1 to 1 around `x` at depth 2, unless its focal length is another."""
    K = torch.tensor([[focal or size, 0, size / 2], [0, focal or size, size / 2], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[0, 3], viewmat[2, 3] = -x, back
    return Camera(viewmat, K.float(), size, size)


def wall(depth: float) -> Tensor:
    """Points [P, 3] of a wall that fills the views of cameras near the origin."""
    y, x = torch.meshgrid(torch.linspace(-4, 4, 41), torch.linspace(-4, 4, 41), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, depth)], dim=-1).reshape(-1, 3)


def checks(size: int, rows: int) -> Tensor:
    """An image [size, size, 3]: a chequered pattern in the first `rows`, grey below."""
    image = torch.full((size, size, 3), 0.5)
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(size), indexing="ij")
    image[:rows] = ((x + y) % 2)[..., None].float()
    return image


@pytest.mark.parametrize(("depth", "first"), [(2.0, 10), (4.0, 5)])
def test_coverage_is_by_depth_and_camera(depth: float, first: int) -> None:
    covered = coverage(camera(20), [camera(100, x=1.0)], wall(depth), NEAR)
    expected = torch.zeros(20, 20, dtype=torch.bool)
    expected[:, first:] = True
    assert torch.equal(covered, expected)


def test_several_views_cover_together() -> None:
    covered = coverage(camera(20), [camera(100, x=1.5), camera(100, x=-1.5)], wall(2.0), NEAR)
    columns = torch.cat([torch.ones(5), torch.zeros(10), torch.ones(5)]).bool()
    assert torch.equal(covered, columns.expand(20, 20))


@pytest.mark.parametrize(
    ("others", "points"),
    [
        ([camera(20)], wall(2.0)),  # the same sampling rate
        ([camera(100, focal=20)], wall(2.0)),  # a larger image of the same sampling rate
        ([camera(100, x=5.0)], wall(2.0)),  # another part of the wall
        ([camera(100)], wall(-2.0)),  # points behind the camera
        ([], wall(2.0)),
    ],
)
def test_what_is_not_covered(others: list[Camera], points: Tensor) -> None:
    assert not coverage(camera(20), others, points, NEAR).any()


def test_a_few_stray_points_do_not_move_the_depth() -> None:
    """Two points between the camera and the wall, in view, that would move a mean of depths."""
    stray = torch.tensor([[0.0, 0.0, 0.1], [-0.2, 0.0, 0.5]])
    others = [camera(100, x=1.0)]
    alone = coverage(camera(20), others, stray, NEAR)
    expected = coverage(camera(20), others, wall(2.0), NEAR)
    assert not torch.equal(alone, expected)
    both = coverage(camera(20), others, torch.cat([wall(2.0), stray]), NEAR)
    assert torch.equal(both, expected)


def test_a_point_nearer_than_near_is_seen_by_no_view() -> None:
    """The wall is 2 before one camera and 3 before the other; only one of them sees it."""
    close, away = camera(20), camera(20, back=1.0)
    finer_close, finer_away = camera(100), camera(100, back=1.0)
    assert coverage(close, [finer_away], wall(2.0), NEAR).all()
    assert not coverage(close, [finer_away], wall(2.0), near=2.5).any()
    assert coverage(away, [finer_close], wall(2.0), NEAR).any()
    assert not coverage(away, [finer_close], wall(2.0), near=2.5).any()


def views(rows: int = 10) -> list[LoadedView]:
    return [
        LoadedView("low", "LR", camera(20), checks(20, rows)),
        LoadedView("high", "HR", camera(100, x=1.0), checks(100, 100)),
    ]


def test_textured_and_covered_pixels_alone_are_attenuated() -> None:
    attenuations = region_attenuations(RegionWeightingConf(texture=0.07), views(), wall(2.0), NEAR)
    assert set(attenuations) == {"low"}
    attenuation = attenuations["low"]
    assert (attenuation[:9, 10:] == 1).all()
    assert (attenuation[:, :10] == 0).all()  # no HR view covers these
    assert (attenuation[13:] == 0).all()  # these are flat


def test_the_attenuation_is_proportional_to_the_texture() -> None:
    coarse = region_attenuations(RegionWeightingConf(texture=8.0), views(), wall(2.0), NEAR)["low"]
    coarser = region_attenuations(RegionWeightingConf(texture=16.0), views(), wall(2.0), NEAR)[
        "low"
    ]
    # The gradient of a chequered pattern is 1 along both axes.
    torch.testing.assert_close(coarse[:7, 10:], torch.full((7, 10), 2**0.5 / 8))
    torch.testing.assert_close(coarser, coarse / 2)


def test_training_gives_attenuated_pixels_less_weight(baseline: Conf) -> None:
    conf = baseline.components
    conf.loss_weighting.lr_weight = 0.25
    conf.region_weighting.texture = 0.07
    low, high = views()
    points = wall(2.0)
    data = Dataset((low, high), (), points, points, 1.0, 5)
    parts = components.build(conf, data, baseline.splat)
    step = Step(0, 30_000, low)
    relative = parts.pixel_weights(step)
    assert relative is not None
    weights = relative * parts.modify_loss(torch.tensor(1.0), low.image, NO_GAUSSIANS, step)
    attenuation = region_attenuations(conf.region_weighting, (low, high), points, NEAR)["low"]
    torch.testing.assert_close(weights, 1 - 0.75 * attenuation)
    assert weights.min() < 0.26
    assert weights.max() > 0.99
    step = Step(0, 30_000, high)
    loss = torch.tensor(0.3)
    assert parts.pixel_weights(step) is None
    assert parts.modify_loss(loss, high.image, NO_GAUSSIANS, step) is loss
