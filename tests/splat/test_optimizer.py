"""The optimizer against torch's own, one Adam a parameter as gsplat has it."""

from __future__ import annotations

import math
from math import nan

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tests.splat.scenes import (
    draw,
    make_camera,
    make_optimizer,
    make_scene,
    normal_parameters,
    take_step,
)
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import OptimizerSettings
from xrgs.splat.sh import C0, sh_basis

# gsplat 1.5.3, examples/simple_trainer.py; means before the scene's scale.
GSPLAT_RATES = {
    "means": 1.6e-4,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}


def optimizer_of(
    count: int = 5,
    *,
    steps: int = 100,
    dtype: torch.dtype = torch.float64,
    backend: str = "torch",
    settings: OptimizerSettings | None = None,
) -> SplatOptimizer:
    values = normal_parameters(count, 0, dtype=dtype)
    settings = settings or OptimizerSettings()
    return make_optimizer(values, settings, scene_scale=2.0, steps=steps, backend=backend)


def step_of(optimizer: SplatOptimizer, seed: int) -> dict[str, Tensor]:
    """Take a step by random gradients, and return these."""
    of = optimizer.gaussians
    gradients = normal_parameters(len(of), seed, dtype=of.means.dtype)
    take_step(optimizer, gradients)
    return gradients


@pytest.mark.parametrize(
    ("dtype", "fused", "tolerance"),
    [(torch.float64, False, 1e-13), (torch.float32, True, 1e-7), (torch.float32, False, 1e-6)],
)
def test_it_is_one_adam_a_parameter(dtype: torch.dtype, fused: bool, tolerance: float) -> None:
    steps = 40
    optimizer = optimizer_of(steps=steps, dtype=dtype)
    expected = make_optimizer(normal_parameters(5, 0, dtype=dtype)).gaussians
    theirs = {
        name: torch.optim.Adam(
            [expected[name]],
            lr=rate * (2.0 if name == "means" else 1.0),
            betas=(0.9, 0.999),
            eps=1e-15,
            foreach=False,
            fused=fused,
        )
        for name, rate in GSPLAT_RATES.items()
    }
    decay = torch.optim.lr_scheduler.ExponentialLR(theirs["means"], gamma=0.01 ** (1.0 / steps))
    for seed in range(steps):
        gradients = step_of(optimizer, seed)
        for name, adam in theirs.items():
            expected[name].grad = gradients[name]
            adam.step()
        decay.step()
    for name in PARAMETERS:
        start = normal_parameters(5, 0, dtype=dtype)[name]
        ours, reference = optimizer.gaussians[name].detach(), expected[name].detach()
        assert (ours != start).all()
        torch.testing.assert_close(ours, reference, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("waits", [0, 5])
def test_the_rate_of_means_decays_to_a_hundredth(waits: int) -> None:
    """After `waits` of 20 steps."""
    optimizer = optimizer_of(steps=20, settings=OptimizerSettings(means_decay_from=1500 * waits))
    rates = []
    for seed in range(21):
        rates.append(optimizer.rates["means"])
        step_of(optimizer, seed)
    decaying = [3.2e-4 * 0.01 ** (step / (20 - waits)) for step in range(1, 21 - waits)]
    assert rates == pytest.approx([3.2e-4] * (waits + 1) + decaying)
    assert optimizer.rates | {"means": 1.6e-4} == pytest.approx(GSPLAT_RATES)


def rates_over_a_run(steps: int, settings: OptimizerSettings) -> tuple[Tensor, Tensor]:
    """Some steps, 1000 at most, and the rates before each of these, [S, 6].

    The columns are scales, quats, sh0, shN, means and opacities.
    """
    names = ("scales", "quats", "sh0", "shN", "means", "opacities")
    optimizer = optimizer_of(steps=steps, settings=settings)
    done, rows = torch.arange(0, steps, max(1, steps // 1000)), []
    for step in done.tolist():
        if step:
            optimizer.steps_done = step - 1
            optimizer.skip_step()
        rows.append([optimizer.rates[name] for name in names])
    return done, torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize(("steps", "power"), [(1, 0.5), (7, 1.0), (600, 0.5)])
def test_the_rates_fit_the_length_of_a_run(steps: int, power: float) -> None:
    """Against the formula: constant for six tenths of the run, then exponentially to gsplat's."""
    done, found = rates_over_a_run(steps, OptimizerSettings(length_power=power))
    _, plain = rates_over_a_run(steps, OptimizerSettings())
    share = done.double() / steps
    first = math.log(30_000 / steps) * power
    logarithm = torch.where(share < 0.6, first, first * (1 - (share - 0.6) / 0.4))
    expected = logarithm.exp()[:, None] * plain[:, :4]
    torch.testing.assert_close(found[:, :4], expected, rtol=1e-12, atol=0)
    assert torch.equal(found[:, 4:], plain[:, 4:])  # means and opacities as they are


@pytest.mark.parametrize("steps", [30_000, 30_001])
def test_a_long_run_has_gsplats_rates_to_the_bit(steps: int) -> None:
    _, fitted = rates_over_a_run(steps, OptimizerSettings(length_power=0.5))
    assert torch.equal(fitted, rates_over_a_run(steps, OptimizerSettings())[1])


def test_fitted_rates_go_on_after_a_checkpoint() -> None:
    settings = OptimizerSettings(length_power=0.5, length_decay_from=10_000)
    one = optimizer_of(steps=9, settings=settings)
    for seed in range(7):
        step_of(one, seed)
    other = optimizer_of(steps=9, settings=settings)
    other.load_state_dict(one.state_dict())
    assert other.rates == one.rates != optimizer_of(steps=9, settings=settings).rates


def test_a_skipped_step_moves_nothing_and_the_rate_goes_on() -> None:
    skipping, other = optimizer_of(steps=8), optimizer_of(steps=8)
    step_of(skipping, 1)
    before = {name: skipping.gaussians[name].detach().clone() for name in PARAMETERS}
    skipping.skip_step()
    assert all(torch.equal(skipping.gaussians[name], before[name]) for name in PARAMETERS)
    step_of(other, 1)
    step_of(other, 2)
    assert skipping.steps_done == other.steps_done == 2
    assert skipping.rates["means"] == other.rates["means"]
    assert skipping.adam["means"]["step"] == 1  # of Adam's own steps


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_the_gradient_of_harmonics_follows_from_that_of_sh0(sh_degree: int) -> None:
    """Against autograd through the rasterizer."""
    camera = make_camera(turned=True)
    scene = make_scene(30, camera)
    gaussians = Gaussians(**{name: value.requires_grad_() for name, value in scene.items()})
    render = draw(vars(gaussians), camera, sh_degree=sh_degree)
    torch.autograd.backward(render.image.square().sum())
    expected = gaussians.shN.grad
    assert expected is not None
    assert bool(expected.any()) == (sh_degree > 0)
    optimizer = SplatOptimizer(gaussians, OptimizerSettings(), scene_scale=1.0, steps=10)
    gaussians.shN.grad = None
    optimizer.step(camera, sh_degree=sh_degree)
    assert gaussians.shN.grad is not None
    torch.testing.assert_close(gaussians.shN.grad, expected, rtol=1e-12, atol=1e-14)


def test_without_a_gradient_of_sh0_harmonics_stay(backend: str) -> None:
    optimizer = optimizer_of(dtype=torch.float32, backend=backend)
    before = optimizer.gaussians.shN.detach().clone()
    take_step(optimizer, {"means": torch.ones(5, 3)}, make_camera(), 3)
    assert optimizer.gaussians.shN.grad is None
    assert torch.equal(optimizer.gaussians.shN, before)


def test_the_harmonics_move_at_every_third_step(backend: str) -> None:
    """Against an Adam of three times the rate that steps as often, on the same gradients."""
    camera, dtype = make_camera(), torch.float32
    optimizer = optimizer_of(dtype=dtype, backend=backend, settings=OptimizerSettings(shN_every=3))
    expected = normal_parameters(5, 0, dtype=dtype)["shN"].requires_grad_()
    theirs = torch.optim.Adam([expected], lr=3 * GSPLAT_RATES["shN"], eps=1e-15)
    for step in range(7):
        values = normal_parameters(5, 10 + step, dtype=dtype)
        before = optimizer.gaussians.shN.detach().clone()
        take_step(optimizer, {"sh0": values["sh0"]}, camera, 3)
        after = optimizer.gaussians.shN.detach()
        assert torch.equal(before, after) == (step % 3 != 0)
        if step % 3 == 0:
            dirs = normalize(optimizer.gaussians.means.detach() - camera.position.to(dtype), dim=-1)
            basis = sh_basis(3, dirs)[:, 1:, None]
            expected.grad = basis * values["sh0"] / C0
            theirs.step()
        torch.testing.assert_close(after, expected.detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means_decay_from", -1),
        ("means_decay_from", 30_000),
        ("length_decay_from", -1),
        ("length_decay_from", 30_000),
        ("length_power", -0.1),
        ("length_power", nan),
        ("shN_every", 0),
    ],
)
def test_schedules_without_meaning_are_refused(name: str, value: float) -> None:
    settings = OptimizerSettings()
    setattr(settings, name, value)
    with pytest.raises(ValueError, match=name):
        optimizer_of(settings=settings)


def test_no_gaussians_left(backend: str) -> None:
    optimizer = optimizer_of(5, dtype=torch.float32, backend=backend)
    step_of(optimizer, 1)
    optimizer.keep(torch.zeros(5, dtype=torch.bool))
    step_of(optimizer, 2)
    assert len(optimizer.gaussians) == 0
    assert optimizer.adam["means"]["step"] == 2
    optimizer.append(normal_parameters(2, 3))
    step_of(optimizer, 4)
    assert optimizer.gaussians.means.isfinite().all()


def test_state_is_counted_in_bytes() -> None:
    optimizer = optimizer_of(5, dtype=torch.float32)
    step_of(optimizer, 1)
    steps = 6 * 4
    assert optimizer.state_bytes() == 2 * 5 * (3 + 4 + 3 + 1 + 3 + 45) * 4 + steps
    optimizer.keep(torch.arange(3))
    assert optimizer.state_bytes() == 2 * 3 * (3 + 4 + 3 + 1 + 3 + 45) * 4 + steps
