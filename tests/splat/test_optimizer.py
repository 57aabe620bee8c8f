"""The optimizer against torch's own, one Adam a parameter as gsplat has it."""

from __future__ import annotations

import math
from math import inf, nan
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tests.splat.scenes import make_camera, normal_parameters
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


def gaussians_of(values: dict[str, Tensor]) -> Gaussians:
    return Gaussians(**{name: value.clone().requires_grad_() for name, value in values.items()})


def optimizer_of(
    count: int = 5,
    *,
    steps: int = 100,
    dtype: torch.dtype = torch.float64,
    backend: str = "torch",
    settings: OptimizerSettings | None = None,
) -> SplatOptimizer:
    gaussians = gaussians_of(normal_parameters(count, 0, dtype=dtype))
    settings = settings or OptimizerSettings()
    return SplatOptimizer(gaussians, settings, scene_scale=2.0, steps=steps, backend=backend)


def take_step(optimizer: SplatOptimizer, seed: int) -> dict[str, Tensor]:
    gradients = normal_parameters(
        len(optimizer.gaussians), seed, dtype=optimizer.gaussians.means.dtype
    )
    optimizer.zero_grad()
    for name in PARAMETERS:
        optimizer.gaussians[name].grad = gradients[name].clone()
    optimizer.step()
    return gradients


def moments(optimizer: SplatOptimizer, name: str) -> tuple[Tensor, Tensor]:
    state = optimizer.adam[name]
    return state["exp_avg"], state["exp_avg_sq"]


@pytest.mark.parametrize(
    ("dtype", "fused", "tolerance"),
    [(torch.float64, False, 1e-13), (torch.float32, True, 1e-7), (torch.float32, False, 1e-6)],
)
def test_it_is_one_adam_a_parameter(dtype: torch.dtype, fused: bool, tolerance: float) -> None:
    steps = 40
    optimizer = optimizer_of(steps=steps, dtype=dtype)
    expected = gaussians_of(normal_parameters(5, 0, dtype=dtype))
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
        gradients = take_step(optimizer, seed)
        for name, adam in theirs.items():
            expected[name].grad = gradients[name]
            adam.step()
        decay.step()
    for name in PARAMETERS:
        start = normal_parameters(5, 0, dtype=dtype)[name]
        ours, reference = optimizer.gaussians[name].detach(), expected[name].detach()
        assert (ours != start).all()
        torch.testing.assert_close(ours, reference, rtol=tolerance, atol=tolerance)


def test_the_rate_of_means_decays_to_a_hundredth() -> None:
    optimizer = optimizer_of(steps=8)
    rates = []
    for seed in range(8):
        rates.append(optimizer.rates["means"])
        take_step(optimizer, seed)
    rates.append(optimizer.rates["means"])
    assert rates == pytest.approx([1.6e-4 * 2.0 * 0.01 ** (step / 8) for step in range(9)])
    assert rates[-1] == pytest.approx(1.6e-4 * 2.0 * 0.01)
    optimizer.rates["means"] = GSPLAT_RATES["means"]
    assert optimizer.rates == pytest.approx(GSPLAT_RATES)


def test_the_decay_of_the_rate_of_means_may_wait() -> None:
    optimizer = optimizer_of(steps=20, settings=OptimizerSettings(means_decay_from=7500))
    rates = []
    for seed in range(21):
        rates.append(optimizer.rates["means"])
        take_step(optimizer, seed)
    waiting = [3.2e-4] * 6  # after 0 to 5 steps, a quarter of the run
    assert rates == pytest.approx(waiting + [3.2e-4 * 0.01 ** (s / 15) for s in range(1, 16)])


def rates_over_a_run(steps: int, settings: OptimizerSettings) -> Tensor:
    """The rates of scales, quats, sh0, shN, means and opacities before each step, [steps, 6]."""
    names = ("scales", "quats", "sh0", "shN", "means", "opacities")
    optimizer = optimizer_of(steps=steps, settings=settings)
    rows = []
    for _ in range(steps):
        rows.append([optimizer.rates[name] for name in names])
        optimizer.skip_step()
    return torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize("power", [0.5, 1.0])
@pytest.mark.parametrize("steps", [1, 7, 600, 30_000])
def test_the_rates_fit_the_length_of_a_run(steps: int, power: float) -> None:
    """Against the formula: constant for six tenths of the run, then exponentially to gsplat's."""
    found = rates_over_a_run(steps, OptimizerSettings(length_power=power))
    plain = rates_over_a_run(steps, OptimizerSettings())
    done = torch.arange(steps, dtype=torch.float64) / steps
    first, last = math.log(30_000 / steps) * power, 0.0
    logarithm = torch.where(done < 0.6, first, first + (last - first) * (done - 0.6) / 0.4)
    expected = logarithm.exp()[:, None] * plain[:, :4]
    torch.testing.assert_close(found[:, :4], expected, rtol=1e-12, atol=0)
    assert torch.equal(found[:, 4:], plain[:, 4:])  # means and opacities as they are


def test_a_long_run_has_gsplats_rates_to_the_bit() -> None:
    for steps in (30_000, 30_001):
        fitted = rates_over_a_run(steps, OptimizerSettings(length_power=0.5))
        assert torch.equal(fitted, rates_over_a_run(steps, OptimizerSettings()))


def test_fitted_rates_go_on_after_a_checkpoint() -> None:
    settings = OptimizerSettings(length_power=0.5, length_decay_from=10_000)
    one = optimizer_of(steps=9, settings=settings)
    for seed in range(7):
        take_step(one, seed)
    other = optimizer_of(steps=9, settings=settings)
    other.load_state_dict(one.state_dict())
    assert other.rates == one.rates != optimizer_of(steps=9, settings=settings).rates


def test_a_skipped_step_moves_nothing_and_the_rate_goes_on() -> None:
    skipping, other = optimizer_of(steps=8), optimizer_of(steps=8)
    take_step(skipping, 1)
    before = {name: skipping.gaussians[name].detach().clone() for name in PARAMETERS}
    skipping.skip_step()
    assert all(torch.equal(skipping.gaussians[name], before[name]) for name in PARAMETERS)
    take_step(other, 1)
    take_step(other, 2)
    assert skipping.steps_done == other.steps_done == 2
    assert skipping.rates["means"] == other.rates["means"]
    assert skipping.adam["means"]["step"] == 1  # of Adam's own steps


def test_the_harmonics_move_at_every_third_step(backend: str) -> None:
    """Against an Adam of three times the rate that steps as often, on the same gradients."""
    camera, dtype = make_camera(), torch.float32
    optimizer = optimizer_of(dtype=dtype, backend=backend, settings=OptimizerSettings(shN_every=3))
    expected = normal_parameters(5, 0, dtype=dtype)["shN"].requires_grad_()
    theirs = torch.optim.Adam([expected], lr=3 * GSPLAT_RATES["shN"], eps=1e-15)
    for step in range(7):
        values = normal_parameters(5, 10 + step, dtype=dtype)
        optimizer.zero_grad()
        optimizer.gaussians.sh0.grad = values["sh0"].clone()
        before = optimizer.gaussians.shN.detach().clone()
        optimizer.step(camera, sh_degree=3)
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


@pytest.mark.parametrize(
    ("name", "value"), [("steps", 0), *(("scene_scale", v) for v in (0.0, -1.0, nan, inf))]
)
def test_a_run_without_meaning_is_refused(name: str, value: float) -> None:
    options: dict[str, Any] = {"scene_scale": 1.0, "steps": 10, name: value}
    gaussians = gaussians_of(normal_parameters(2, 0))
    with pytest.raises(ValueError, match=name):
        SplatOptimizer(gaussians, OptimizerSettings(), **options)


def test_training_goes_on_after_a_change() -> None:
    optimizer = optimizer_of(5)
    take_step(optimizer, 1)
    optimizer.append(normal_parameters(2, 3, dtype=torch.float64))
    optimizer.keep(torch.tensor([6, 1]))
    first = optimizer.gaussians.scales.detach().clone()
    gradients = take_step(optimizer, 4)
    # A new Gaussian's first update, by hand, at the old ones' second step.
    g = gradients["scales"][0]
    mean, square = 0.1 * g / (1 - 0.9**2), 0.001 * g**2 / (1 - 0.999**2)
    expected = first[0] - 5e-3 * mean / (square.sqrt() + 1e-15)
    torch.testing.assert_close(optimizer.gaussians.scales.detach()[0], expected)


def test_changes_before_the_first_step() -> None:
    optimizer = optimizer_of(5)
    optimizer.keep(torch.tensor([1, 2]))
    optimizer.append(normal_parameters(1, 1, dtype=torch.float64))
    optimizer.reset("opacities", torch.zeros(3, dtype=torch.float64))
    assert optimizer.state_bytes() == 0
    take_step(optimizer, 2)
    assert moments(optimizer, "means")[0].shape == (3, 3)


def test_no_gaussians_left(backend: str) -> None:
    optimizer = optimizer_of(5, dtype=torch.float32, backend=backend)
    take_step(optimizer, 1)
    optimizer.keep(torch.zeros(5, dtype=torch.bool))
    take_step(optimizer, 2)
    assert len(optimizer.gaussians) == 0
    assert optimizer.adam["means"]["step"] == 2
    optimizer.append(normal_parameters(2, 3))
    take_step(optimizer, 4)
    assert optimizer.gaussians.means.isfinite().all()


def test_state_is_counted_in_bytes() -> None:
    optimizer = optimizer_of(5, dtype=torch.float32)
    take_step(optimizer, 1)
    steps = 6 * 4
    assert optimizer.state_bytes() == 2 * 5 * (3 + 4 + 3 + 1 + 3 + 45) * 4 + steps
    optimizer.keep(torch.arange(3))
    assert optimizer.state_bytes() == 2 * 3 * (3 + 4 + 3 + 1 + 3 + 45) * 4 + steps
