"""The compiled Adam against torch's own, on the same state."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.splat.scenes import make_camera, make_optimizer, normal_parameters, take_step
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import OptimizerSettings

native = pytest.importorskip("xrgs._native")

Array = np.ndarray[Any, Any]

ULP = 2.0**-23


def optimizer(count: int, backend: str) -> SplatOptimizer:
    values = normal_parameters(count, 0)
    return make_optimizer(values, OptimizerSettings(), scene_scale=2.0, steps=100, backend=backend)


def assert_same(ours: SplatOptimizer, theirs: SplatOptimizer, steps: int) -> None:
    """Equal but for rounding: an ulp a step of the moments, and of the distance gone.

    A moment's error shrinks by its beta each step and gains the roundings of one step; a parameter
    gains a rounding of itself and four of its step's length, the rate at most.
    """
    for name in PARAMETERS:
        for which, memory in (("exp_avg", 10), ("exp_avg_sq", 1000)):
            a, b = ours.adam[name][which], theirs.adam[name][which]
            # Of a first moment, whose terms may cancel, relative to the root of the second.
            scale = b if which == "exp_avg_sq" else theirs.adam[name]["exp_avg_sq"].sqrt() * 32
            assert ((a - b).abs() <= 2 * min(steps, memory) * ULP * scale).all(), (name, which)
        a, b = ours.gaussians[name].detach(), theirs.gaussians[name].detach()
        rate = ours.means_rate if name == "means" else ours.rates[name]
        bound = steps * ULP * (b.abs() + 8 * rate)
        assert ((a - b).abs() <= bound).all(), name
        assert ours.adam[name]["step"] == steps


@pytest.mark.parametrize("count", [1, 16, 37])
def test_it_is_torchs_adam_but_for_rounding(isa: str, count: int) -> None:
    ours, theirs = optimizer(count, "native"), optimizer(count, "torch")
    for step in range(1, 41):
        # Sizes as in training, and changing fast.
        gradients = normal_parameters(count, step, size=10.0 ** -(step % 7))
        take_step(ours, gradients)
        take_step(theirs, gradients)
        assert_same(ours, theirs, step)


LR, BETAS, EPS = 1e-3, (0.9, 0.999), 1e-15


@cache
def in_float64(size: float, steps: int, last: int) -> tuple[list[Tensor], Array, Array]:
    """Adam on random gradients of a size, again and again until a last step and zeros after it.

    Returns the gradient of each step in float32, the parameter of Algorithm 1 of Kingma and Ba in
    float64, and a bound of what a float32 may be off. Each step may round the parameter, and move
    it by a share more or less: beta2, a float32, is off by 1.3e-8, which is a share of 1.3e-5 of
    what its powers converge to, and the root of that of a step.
    """
    generator, (beta1, beta2) = np.random.default_rng(0), BETAS
    rows = size * (generator.normal(size=(64, 19)) + generator.choice([-1, 1], 19))
    tensors = [torch.from_numpy(row) for row in (*rows.astype(np.float32), np.zeros(19, "f4"))]
    gradients = [tensors[step % 64 if step <= last else -1] for step in range(1, steps + 1)]
    exact, m, v, bound = (np.zeros(19) for _ in range(4))
    for step, gradient in enumerate(gradients, 1):
        g = gradient.double().numpy()
        m = beta1 * m + (1 - beta1) * g
        v = beta2 * v + (1 - beta2) * g**2
        move = LR * m / (1 - beta1**step) / (np.sqrt(v / (1 - beta2**step)) + EPS)
        exact -= move
        bound += ULP / 2 * np.abs(exact) + 2e-5 * np.abs(move)
    assert (bound < 1e-3 * np.abs(exact)).all()
    return gradients, exact, bound


@pytest.mark.parametrize(
    "trained",
    [
        pytest.param((1e-3, 30_000, 30_000), marks=pytest.mark.slow, id="a long training"),
        *((size, 1100, 100) for size in (1e-12, 1e-3, 1.0)),  # a thousand without gradient
    ],
)
def test_trainings_follow_float64(isa: str, trained: tuple[float, int, int]) -> None:
    gradients, exact, bound = in_float64(*trained)
    parameter, exp_avg, exp_avg_sq = (torch.zeros(19) for _ in range(3))
    for step, gradient in enumerate(gradients, 1):
        group = (parameter, gradient, exp_avg, exp_avg_sq, LR, float(step))
        native.adam_step([group], *BETAS, EPS, 1)
    assert (np.abs(parameter.double().numpy() - exact) <= bound).all()


def change(of: SplatOptimizer, what: str, seed: int) -> None:
    """What densification does to an optimizer."""
    generator = torch.Generator().manual_seed(seed)
    count = len(of.gaussians)
    if what == "append":
        of.append(normal_parameters(1 + seed % 5, seed))
    elif what == "keep":
        of.keep(torch.rand(count, generator=generator) < 0.7)
    elif what == "reset":
        of.reset("opacities", of.gaussians.opacities.detach().clamp_max(-1.0))


@settings(max_examples=30)
@given(
    plan=st.lists(
        st.tuples(
            st.sampled_from(["nothing", "append", "keep", "reset", "no gradient", "band 0"]),
            st.integers(0, 10**6),
            st.integers(-12, 3),
        ),
        min_size=1,
        max_size=25,
    )
)
def test_it_is_torchs_as_gaussians_come_and_go(plan: list[tuple[str, int, int]]) -> None:
    ours, theirs = optimizer(6, "native"), optimizer(6, "torch")
    for step, (what, seed, exponent) in enumerate(plan, start=1):
        gradients = normal_parameters(len(ours.gaussians), seed, size=10.0**exponent)
        if what == "no gradient":
            for gradient in gradients.values():
                gradient[::2] = 0
        elif what == "band 0":
            gradients["shN"].zero_()
        for each in (ours, theirs):
            take_step(each, gradients)
        assert_same(ours, theirs, step)
        for each in (ours, theirs):
            change(each, what, seed)


def test_what_has_no_gradient_yet_stays_to_the_bit() -> None:
    of = optimizer(20, "native")
    before = {name: of.gaussians[name].detach().clone() for name in ("sh0", "shN")}
    gradients = normal_parameters(20, 1)
    del gradients["sh0"]
    gradients["shN"][:, 3:] = 0
    take_step(of, gradients)
    after = of.gaussians.shN.detach().clone()
    # What had one goes on by its momentum.
    take_step(of, {name: torch.zeros_like(g) for name, g in gradients.items()})
    assert (after[:, :3] != before["shN"][:, :3]).all()
    assert (of.gaussians.shN[:, :3] != after[:, :3]).any()
    assert torch.equal(of.gaussians.shN[:, 3:], before["shN"][:, 3:])
    assert (of.adam["shN"]["exp_avg"][:, 3:] == 0).all()
    assert torch.equal(of.gaussians.sh0, before["sh0"])
    assert not of.adam["sh0"]


def test_torch_goes_on_from_our_state_and_we_from_its() -> None:
    mixed, theirs = optimizer(9, "native"), optimizer(9, "torch")
    for step in range(1, 11):
        mixed.backend = "native" if step % 3 else "torch"
        gradients = normal_parameters(9, step)
        take_step(mixed, gradients)
        take_step(theirs, gradients)
        assert_same(mixed, theirs, step)


def take_step_of_a_view(of: SplatOptimizer, gradients: dict[str, Tensor], degree: int) -> None:
    of_others = {name: gradients[name] for name in PARAMETERS if name != "shN"}
    take_step(of, of_others, make_camera(turned=True), degree)


@pytest.mark.parametrize(("count", "degree"), [(37, 0), (16, 1), (1, 2), (37, 3)])
def test_harmonics_move_by_the_gradient_that_sh0_implies(isa: str, count: int, degree: int) -> None:
    ours, theirs = optimizer(count, "native"), optimizer(count, "torch")
    before = ours.gaussians.shN.detach().clone()
    gradients = normal_parameters(count, 1, size=1e-3)
    for each in (ours, theirs):
        take_step_of_a_view(each, gradients, degree)
    on = (degree + 1) ** 2 - 1
    for which, power in (("exp_avg", 1), ("exp_avg_sq", 2)):
        a, b = ours.adam["shN"][which], theirs.adam["shN"][which]
        # A basis function is a small sum of products: some roundings of its largest term, below 3.
        scale = (gradients["sh0"].abs() * 12) ** power * (1 - (0.9, 0.999)[power - 1])
        assert ((a - b).abs() <= 16 * ULP * scale).all()
        assert (a[:, :on] != 0).all()
        assert (a[:, on:] == 0).all()
    assert torch.equal(ours.gaussians.shN[:, on:], before[:, on:])
    assert (ours.gaussians.shN[:, :on] != before[:, :on]).all()
    assert ours.gaussians.shN.grad is None
    assert ours.adam["shN"]["step"] == 1
    for name in PARAMETERS[:-1]:  # as without the view
        alone = optimizer(count, "native")
        take_step(alone, {name: gradients[name] for name in PARAMETERS[:-1]})
        assert torch.equal(ours.gaussians[name], alone.gaussians[name])


def test_other_types_and_missing_bands_are_refused() -> None:
    of = optimizer(5, "native")
    of.reset("shN", of.gaussians.shN.detach()[:, :3].contiguous())
    with pytest.raises(ValueError, match="bands of sh_degree"):
        take_step_of_a_view(of, normal_parameters(5, 1), 2)
    of.reset("means", of.gaussians.means.detach().double())
    of.gaussians.means.grad = torch.zeros(5, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match="means must be float32 on the CPU"):
        of.step()
