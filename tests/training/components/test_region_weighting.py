"""Paper 7.2: LR views weigh less where they are textured and an HR view covers them, only there."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from xrgs.capture.dataset import Dataset, LoadedView
from xrgs.config import Conf, RegionWeightingConf
from xrgs.splat.cameras import Camera
from xrgs.training import components
from xrgs.training.components import Step
from xrgs.training.components.region_weighting import coverage, region_shares

NEAR = 0.01


def camera(size: int, *, x: float = 0.0, focal: float | None = None) -> Camera:
    """Sees -1 to 1 around `x` at depth 2, unless its focal length is another."""
    K = torch.tensor([[focal or size, 0, size / 2], [0, focal or size, size / 2], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, K.float(), size, size)


def wall(depth: float) -> Tensor:
    """Points [P, 3] all over what cameras near the origin see."""
    y, x = torch.meshgrid(torch.linspace(-4, 4, 41), torch.linspace(-4, 4, 41), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, depth)], dim=-1).reshape(-1, 3)


def checks(size: int, rows: int) -> Tensor:
    """[size, size, 3]: a chequered pattern above, grey below the first `rows`."""
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
        ([camera(20)], wall(2.0)),  # sees it no finer
        ([camera(100, focal=20)], wall(2.0)),  # larger, and still no finer
        ([camera(100, x=5.0)], wall(2.0)),  # looks elsewhere
        ([camera(100)], wall(-2.0)),  # no point in view
        ([], wall(2.0)),
    ],
)
def test_what_is_not_covered(others: list[Camera], points: Tensor) -> None:
    assert not coverage(camera(20), others, points, NEAR).any()


def test_a_few_stray_points_do_not_move_the_depth() -> None:
    points = torch.cat([wall(2.0), torch.tensor([[0.05, 0.05, 0.1], [-0.5, 0.0, 0.5]])])
    others = [camera(100, x=1.0)]
    expected = coverage(camera(20), others, wall(2.0), NEAR)
    assert torch.equal(coverage(camera(20), others, points, NEAR), expected)


def views(rows: int = 10) -> list[LoadedView]:
    return [
        LoadedView("low", "LR", camera(20), checks(20, rows)),
        LoadedView("high", "HR", camera(100, x=1.0), checks(100, 100)),
    ]


def test_the_share_is_high_where_textured_and_covered_alone() -> None:
    shares = region_shares(RegionWeightingConf(0.07), views(), wall(2.0), NEAR)
    assert set(shares) == {"low"}
    share = shares["low"]
    assert (share[:9, 10:] == 1).all()
    assert (share[:, :10] == 0).all()  # no HR view
    assert (share[13:] == 0).all()  # nothing to attenuate


def test_half_the_texture_is_half_the_share() -> None:
    strong = region_shares(RegionWeightingConf(8.0), views(), wall(2.0), NEAR)["low"]
    weak = region_shares(RegionWeightingConf(16.0), views(), wall(2.0), NEAR)["low"]
    # A chequered pattern's slope: 1 both ways.
    torch.testing.assert_close(strong[:7, 10:], torch.full((7, 10), 2**0.5 / 8))
    torch.testing.assert_close(weak, strong / 2)


def test_training_weighs_those_pixels_less(baseline: Conf) -> None:
    conf = baseline.components
    conf.loss_weighting.lr_weight = 0.25
    conf.region_weighting.texture = 0.07
    low, high = views()
    points = wall(2.0)
    data = Dataset((low, high), (), points, points, 1.0, 5)
    parts = components.build(conf, data, baseline.splat)
    step = Step(0, 30_000, low)
    relative = parts.pixel_weight(step)
    assert relative is not None
    weights = relative * parts.loss(torch.tensor(1.0), low.image, step)
    share = region_shares(conf.region_weighting, (low, high), points, NEAR)["low"]
    torch.testing.assert_close(weights, 1 - 0.75 * share)
    assert weights.min() < 0.26
    assert weights.max() > 0.99
    step = Step(0, 30_000, high)
    loss = torch.tensor(0.3)
    assert parts.pixel_weight(step) is None
    assert parts.loss(loss, high.image, step) is loss
