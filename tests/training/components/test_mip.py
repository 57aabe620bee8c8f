"""Mip-Splatting's 3D filter, at the highest sampling rate of the views that see a Gaussian."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf, MipConf
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.training.components import Components, Step
from xrgs.training.components.mip import Mip, sampling_rates
from xrgs.training.dataset import LoadedView

NEAR = 0.01
SIZE = 40


def camera(focal: float, *, back: float, fy: float | None = None) -> Camera:
    """Looks along z, `back` world units before the origin."""
    K = torch.tensor([[focal, 0, SIZE / 2], [0, fy or focal, SIZE / 2], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = back
    return Camera(viewmat, K, SIZE, SIZE)


def view(tag: str, camera: Camera) -> LoadedView:
    return LoadedView(tag.lower(), tag, camera, torch.zeros(SIZE, SIZE, 3))


#: 25 px a world unit at the origin, from afar; 20 from near by. Largest focal length over nearest
#: distance, which belong to no view, would be 100.
FAR, CLOSE = camera(100.0, back=4.0), camera(20.0, back=1.0)
STEP = Step(0, 30_000, view("LR", CLOSE))


def splats(*means: tuple[float, float, float]) -> Gaussians:
    count = len(means)
    generator = torch.Generator().manual_seed(0)
    values = {
        "means": torch.tensor(means),
        "quats": torch.rand(count, 4, generator=generator),
        "scales": torch.log(torch.rand(count, 3, generator=generator) * 0.02),
        "opacities": torch.full((count,), 0.6).logit(),
        "sh0": torch.rand(count, 1, 3, generator=generator),
        "shN": torch.zeros(count, 0, 3),
    }
    return Gaussians(**{name: value.requires_grad_() for name, value in values.items()})


def on(*cameras: Camera, every: int = 100) -> Mip:
    views = [view("LR" if c is CLOSE else "HR", c) for c in cameras]
    return Mip(MipConf(variance=0.2, every=every), views, NEAR)


def test_two_cameras_of_differing_focal_length_and_distance() -> None:
    gaussians = splats((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 12.0))
    mip = on(CLOSE, FAR)
    mip.on_gaussians_changed(gaussians)
    plain = gaussians.activated()
    filtered = mip.before_render(plain, STEP)
    # f / z of each: 100/4 and 20/1, 100/5 and 20/2, 100/16 and 20/13.
    nu = torch.tensor([25.0, 20.0, 6.25], dtype=torch.float64)
    scales, opacities = plain.scales.double(), plain.opacities.double()
    wider = (scales**2 + (0.2 / nu**2)[:, None]).sqrt()
    weaker = opacities * (scales.prod(-1) ** 2 / wider.prod(-1) ** 2).sqrt()
    torch.testing.assert_close(filtered.scales.double(), wider, rtol=1e-6, atol=0)
    torch.testing.assert_close(filtered.opacities.double(), weaker, rtol=1e-5, atol=0)
    assert (weaker < 0.9 * opacities).all()
    for name in ("means", "quats", "sh0", "shN"):
        assert getattr(filtered, name) is getattr(plain, name)


def test_a_view_that_does_not_see_a_gaussian_does_not_count() -> None:
    # At depth 4 FAR sees 0.8 to each side, and a margin of 15 % of 1.6 more.
    edge = 0.8 + 0.15 * 1.6
    means = torch.tensor([[edge - 0.01, 0.0, 0.0], [edge + 0.01, 0.0, 0.0], [0.0, 0.0, -2.0]])
    rates = sampling_rates(means, [FAR, CLOSE], NEAR)
    torch.testing.assert_close(rates, torch.tensor([25.0, 20.0, 50.0]))
    assert torch.equal(sampling_rates(-means - 9, [CLOSE], NEAR), torch.zeros(3))
    # The margin is around all four sides, and the finer axis of a view counts.
    turned = torch.stack([means[:2, [1, 0, 2]], -means[:2]]).reshape(-1, 3)
    assert sampling_rates(turned, [FAR], NEAR).tolist() == [25.0, 0.0] * 2
    for fx, fy in ((100.0, 120.0), (120.0, 100.0)):
        rates = sampling_rates(torch.zeros(1, 3), [camera(fx, fy=fy, back=4.0)], NEAR)
        assert rates.item() == pytest.approx(30.0)


def test_a_view_does_not_see_what_is_nearer_than_near(build: Build, off: ComponentsConf) -> None:
    means = torch.tensor([[0.0, 0.0, -0.992], [0.0, 0.0, -0.98]])  # depths of 0.008 and 0.02
    torch.testing.assert_close(sampling_rates(means, [CLOSE], NEAR), torch.tensor([0.0, 1000.0]))
    at_near = sampling_rates(means, [CLOSE], float(means[1, 2]) + 1.0)  # exactly the second's depth
    assert torch.equal(at_near, torch.zeros(2))
    off.mip.variance = 0.2
    (mip,) = build(off, view("LR", CLOSE))
    assert isinstance(mip, Mip)
    mip.on_gaussians_changed(splats((0.0, 0.0, -0.992), (0.0, 0.0, 0.0)))
    assert mip.unseen_count == 1  # the model's near plane is 0.01


def test_rates_follow_the_means_every_so_often() -> None:
    gaussians = splats((0.0, 0.0, 0.0))
    mip = on(FAR, every=100)
    mip.on_gaussians_changed(gaussians)
    before = mip.variance.clone()
    with torch.no_grad():
        gaussians.means[0, 2] = 4.0
    mip.before_render(gaussians.activated(), Step(199, 30_000, STEP.view))
    assert torch.equal(mip.variance, before)
    mip.before_render(gaussians.activated(), Step(200, 30_000, STEP.view))
    torch.testing.assert_close(mip.variance, 4 * before)


def test_what_is_saved_renders_as_what_was_trained() -> None:
    gaussians = splats((0.0, 0.0, 0.0), (0.1, 0.05, 0.5), (50.0, 0.0, 0.0))
    mip = on(FAR, CLOSE)
    mip.on_gaussians_changed(gaussians)
    settings = RasterSettings(antialiased=True, sh_degree=0)

    def image(activated: ActivatedGaussians) -> Tensor:
        return rasterize_parameters(*activated, FAR, settings, sh_degree=0).image

    trained = image(mip.before_render(gaussians.activated(), STEP))
    unfiltered = image(gaussians.activated())
    assert (trained - unfiltered).abs().max() > 0.01
    mip.bake(gaussians)
    torch.testing.assert_close(image(gaussians.activated()), trained, rtol=1e-5, atol=1e-6)
    assert gaussians.scales.is_leaf
    assert gaussians.scales.requires_grad


def test_extreme_gaussians_stay_finite() -> None:
    gaussians = splats(*[(0.0, 0.0, 0.0)] * 4)
    gaussians.scales = torch.tensor([-120.0, -60.0, 0.0, 20.0])[:, None].repeat(1, 3)
    gaussians.opacities = torch.tensor([-120.0, 120.0, 120.0, 120.0])
    for tensor in (gaussians.scales, gaussians.opacities):
        tensor.requires_grad_()
    mip = on(FAR)
    mip.on_gaussians_changed(gaussians)
    filtered = mip.before_render(gaussians.activated(), STEP)
    torch.autograd.backward(filtered.scales.sum() + filtered.opacities.sum())
    for name in ("scales", "opacities"):
        assert torch.isfinite(getattr(filtered, name)).all()
        gradient = gaussians[name].grad
        assert gradient is not None
        assert torch.isfinite(gradient).all()
    mip.bake(gaussians)
    assert torch.isfinite(gaussians.scales).all()
    assert torch.isfinite(gaussians.opacities).all()


def test_the_history_has_the_mean_filter_and_the_number_of_unseen_gaussians() -> None:
    gaussians = splats((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (50.0, 0.0, 0.0))
    mip = on(FAR, CLOSE)
    assert mip.unseen_count == 0
    assert mip.variance.shape == (0,)
    step = Step(0, 30_000, view("LR", CLOSE))
    mip.before_render(gaussians.activated(), step)
    sigma = (0.2**0.5 / torch.tensor([25.0, 20.0, 20.0], dtype=torch.float64)).mean().item()
    assert step.log == {"mip.sigma": pytest.approx(sigma, rel=1e-6), "mip.unseen": 1}
    between = Step(1, 30_000, view("LR", CLOSE))
    mip.before_render(gaussians.activated(), between)
    assert between.log == {}
    # A Gaussian that no view sees takes the lowest rate, however low; all unseen: no filter.
    mip = on(FAR)
    mip.on_gaussians_changed(splats((0.0, 0.0, 0.0), (0.0, 0.0, 396.0), (5000.0, 0.0, 0.0)))
    torch.testing.assert_close(mip.variance, 0.2 / torch.tensor([25.0, 0.25, 0.25]) ** 2)
    unseen = splats((50.0, 0.0, 0.0), (60.0, 0.0, 0.0))
    mip.on_gaussians_changed(unseen)
    plain = unseen.activated()
    filtered = mip.before_render(plain, STEP)
    assert torch.equal(filtered.scales, plain.scales)
    assert torch.equal(filtered.opacities, plain.opacities)


def test_a_reset_caps_what_is_rendered() -> None:
    """Mip-Splatting's reset: the opacity with the filter is at most the cap, for every Gaussian."""
    gaussians = splats((0, 0, 0), (0.1, 0.1, 0.3), (-0.1, 0, -0.2))
    gaussians.scales = torch.full((3, 3), math.log(0.02)).requires_grad_()
    gaussians.opacities = torch.tensor([3.0, -6.0, 1.0]).requires_grad_()
    mip = on(FAR, CLOSE)
    optimizer = SplatOptimizer(gaussians, OptimizerSettings(), scene_scale=1.0, steps=30_000)
    strategy = DefaultStrategy(
        optimizer,
        DensifySettings(prune_opacity=0.001, reset_opacity=10.0),
        scene_scale=1.0,
        generator=torch.Generator(),
    )
    visible = torch.ones(3, dtype=torch.bool)
    hooks = Components([mip]).strategy_hooks(STEP)
    refinement = strategy.after_step(3000, None, visible, width=SIZE, height=SIZE, hooks=hooks)
    assert refinement.reset == 2
    mip.on_gaussians_changed(gaussians)
    rendered = mip.before_render(gaussians.activated(), STEP).opacities.detach()
    torch.testing.assert_close(rendered[[0, 2]], torch.full((2,), 0.01))
    assert gaussians.opacities[1] == -6.0  # it was below the cap before
    assert (gaussians.opacities.detach().sigmoid()[[0, 2]] > 0.01).all()
