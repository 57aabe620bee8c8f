"""Densification against gsplat's `DefaultStrategy`, on the same inputs."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from xrgs.splat.densify import Densifier, Refinement
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.settings import DensifySettings, OptimizerSettings

SCENE_SCALE = 1.7
WIDTH, HEIGHT = 40, 30


def random_values(count: int, rng: np.random.Generator) -> dict[str, Tensor]:
    """Gaussians on both sides of every threshold of the default settings."""
    values = {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": rng.uniform(np.log(0.003), np.log(0.5), size=(count, 1))
        + rng.uniform(-1, 0, size=(count, 3)),
        "opacities": rng.uniform(-7, 3, size=count),
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": rng.normal(size=(count, 3, 3)),
    }
    return {name: torch.from_numpy(value).float() for name, value in values.items()}


def random_gradients(values: dict[str, Tensor], rng: np.random.Generator) -> dict[str, Tensor]:
    return {
        name: torch.from_numpy(rng.normal(size=value.shape)).float()
        for name, value in values.items()
    }


@dataclass
class Observed:
    """What a step's view tells densification."""

    gradient: Tensor  # [N, 2] per px
    visible: Tensor  # [N]
    absgrad: Tensor | None = None  # [N, 2], what gsplat also has of a render with absgrad


def random_view(count: int, rng: np.random.Generator, size: float = 2e-5) -> Observed:
    gradient = rng.normal(size=(count, 2)) * rng.exponential(size, size=(count, 1))
    visible = torch.from_numpy(rng.random(count) < 0.7)
    return Observed(torch.from_numpy(gradient).float() * visible[:, None], visible)


class Ours:
    def __init__(self, values: dict[str, Tensor], config: DensifySettings, seed: int) -> None:
        leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
        self.gaussians = Gaussians(**leaves)
        self.optimizer = SplatOptimizer(
            self.gaussians,
            OptimizerSettings(means_final=1.0),
            scene_scale=SCENE_SCALE,
            steps=1,
        )
        self.densifier = Densifier(
            self.optimizer,
            config,
            scene_scale=SCENE_SCALE,
            generator=torch.Generator().manual_seed(seed),
        )

    def descend(self, gradients: dict[str, Tensor]) -> None:
        for name in PARAMETERS:
            self.gaussians[name].grad = gradients[name].clone()
        self.optimizer.step()

    def densify(self, step: int, view: Observed) -> Refinement:
        return self.densifier.after_step(
            step, view.gradient, view.visible, width=WIDTH, height=HEIGHT
        )


class Theirs:
    """gsplat's strategy with an Adam a parameter, as its trainer has them."""

    def __init__(self, values: dict[str, Tensor], config: DensifySettings, seed: int) -> None:
        from gsplat.strategy import DefaultStrategy

        self.params = {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
        rates = OptimizerSettings()
        self.optimizers = {
            name: torch.optim.Adam(
                [self.params[name]],
                lr=getattr(rates, name) * (SCENE_SCALE if name == "means" else 1),
                eps=1e-15,
                fused=True,
            )
            for name in PARAMETERS
        }
        self.strategy = DefaultStrategy(
            prune_opa=config.prune_opacity,
            grow_grad2d=config.grow_grad2d,
            grow_scale3d=config.grow_scale3d,
            prune_scale3d=config.prune_scale3d,
            refine_start_iter=config.start,
            refine_stop_iter=config.stop,
            reset_every=config.reset_every,
            refine_every=config.every,
        )
        self.state = self.strategy.initialize_state(SCENE_SCALE)
        # It draws from torch's global generator, whose state is ours between its calls.
        self.random = torch.Generator().manual_seed(seed).get_state()

    def descend(self, gradients: dict[str, Tensor]) -> None:
        for name, optimizer in self.optimizers.items():
            self.params[name].grad = gradients[name].clone()
            optimizer.step()

    def densify(self, step: int, view: Observed, *, with_reset: bool = True) -> None:
        from gsplat.strategy.ops import reset_opa

        info: dict[str, Any] = {
            "width": WIDTH,
            "height": HEIGHT,
            "n_cameras": 1,
            "gaussian_ids": None,
            "radii": view.visible[None, :, None].expand(-1, -1, 2).int(),
            "means2d": SimpleNamespace(grad=view.gradient[None]),
        }
        if view.absgrad is not None:
            info["means2d"].absgrad = view.absgrad[None]
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self.random)
            self.strategy.step_post_backward(self.params, self.optimizers, self.state, step, info)
            self.random = torch.get_rng_state()
        # 1.5.3's own never happens; this is the condition that its pull request 776 restores.
        strategy = self.strategy
        if with_reset and 0 < step < strategy.refine_stop_iter and step % strategy.reset_every == 0:
            value = strategy.prune_opa * 2.0
            reset_opa(self.params, self.optimizers, self.state, value)


def assert_same(ours: Ours, theirs: Theirs) -> None:
    for name in PARAMETERS:
        mine, reference = ours.gaussians[name].detach(), theirs.params[name].detach()
        # Only where a split goes is computed otherwise, by our rotation matrix: last digits.
        tolerance = 1e-5 if name == "means" else 0
        torch.testing.assert_close(mine, reference, rtol=tolerance, atol=tolerance)
        mine_state = ours.optimizer.adam.state[ours.gaussians[name]]
        their_state = theirs.optimizers[name].state[theirs.params[name]]
        assert mine_state.keys() == their_state.keys()
        for key, value in their_state.items():
            assert torch.equal(mine_state[key], value), (name, key)
    if theirs.state["grad2d"] is not None:
        assert torch.equal(ours.densifier.grad2d_sum[0], theirs.state["grad2d"])
        assert torch.equal(ours.densifier.visible_count[0], theirs.state["count"])


@settings(max_examples=60, deadline=None)
@given(
    count=st.integers(1, 60),
    views=st.integers(1, 4),
    step=st.sampled_from([0, 400, 500, 550, 600, 2900, 3000, 3100, 6000, 14_900, 15_000, 15_100]),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_refinement_is_gsplats(count: int, views: int, step: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, config = random_values(count, rng), DensifySettings()
    ours, theirs = Ours(values, config, seed), Theirs(values, config, seed)
    gradients = random_values(count, rng)
    ours.descend(gradients)
    theirs.descend(gradients)
    for _ in range(views - 1):
        view = random_view(count, rng)
        assert ours.densify(1, view) == Refinement()
        theirs.densify(1, view)
    view = random_view(count, rng)
    did = ours.densify(step, view)
    theirs.densify(step, view)
    assert_same(ours, theirs)
    assert len(ours.gaussians) == count + did.duplicated + did.split - did.removed


@pytest.mark.parametrize("seed", range(3))
def test_with_absgrad_a_refinement_is_gsplats(seed: int) -> None:
    """Its recommended threshold, on what `RasterSettings.absgrad` makes the offset's gradient."""
    rng = np.random.default_rng(seed)
    values, config = random_values(80, rng), DensifySettings(grow_grad2d=8e-4)
    ours, theirs = Ours(values, config, seed), Theirs(values, config, seed)
    theirs.strategy.absgrad = True
    gradients = random_values(80, rng)
    ours.descend(gradients)
    theirs.descend(gradients)
    grown = 0
    for step in (1, 600):
        plain, absolute = random_view(80, rng), random_view(80, rng, size=1e-4)
        absolute.visible = plain.visible
        absolute.gradient = absolute.gradient.abs() * plain.visible[:, None]
        did = ours.densify(step, absolute)
        theirs.densify(step, Observed(plain.gradient, plain.visible, absolute.gradient))
        grown += did.duplicated + did.split
    assert 0 < grown < 80
    assert_same(ours, theirs)


def test_a_run_of_3000_steps_is_gsplats() -> None:
    steps = 3000
    config = DensifySettings().scaled(steps)
    rng = np.random.default_rng(0)
    values = random_values(150, rng)
    ours, theirs = Ours(values, config, 1), Theirs(values, config, 1)
    total: dict[str, int] = {}
    for step in range(steps):
        count = len(ours.gaussians)
        if step < config.stop:  # nothing changes after it
            gradients = random_gradients(vars(ours.gaussians), rng)
            gradients["scales"] -= 0.3  # some grow until they are too large
            ours.descend(gradients)
            theirs.descend(gradients)
        view = random_view(count, rng, size=4.4e-6)
        did = ours.densify(step, view)
        theirs.densify(step, view)
        assert len(ours.gaussians) == len(theirs.params["means"])
        assert len(ours.gaussians) == count + did.duplicated + did.split - did.removed
        if did != Refinement():
            assert_same(ours, theirs)
            total = {name: total.get(name, 0) + n for name, n in did.counts().items()}
        if step == config.stop:
            frozen = copy.deepcopy(ours.gaussians)
    assert_same(ours, theirs)
    assert all(torch.equal(ours.gaussians[name], frozen[name]) for name in PARAMETERS)
    # The run went through every rule, many times.
    assert all(n > 50 for name, n in total.items() if name != "pruned_non_finite"), total


def test_gsplat_153_itself_never_resets() -> None:
    """The one difference from the release that is our oracle: were it gone, so would this be."""
    rng = np.random.default_rng(0)
    values = random_values(20, rng)
    theirs = Theirs(values, DensifySettings(start=5000), 0)
    theirs.descend(random_values(20, rng))
    before = theirs.params["opacities"].detach().clone()
    theirs.densify(3000, random_view(20, rng), with_reset=False)
    assert torch.equal(theirs.params["opacities"], before)


def test_the_settings_are_gsplats() -> None:
    from gsplat.strategy import DefaultStrategy

    names = {
        "start": "refine_start_iter",
        "stop": "refine_stop_iter",
        "every": "refine_every",
        "reset_every": "reset_every",
        "grow_grad2d": "grow_grad2d",
        "grow_scale3d": "grow_scale3d",
        "prune_opacity": "prune_opa",
        "prune_scale3d": "prune_scale3d",
    }
    strategy = DefaultStrategy()
    for mine, theirs in names.items():
        assert getattr(DensifySettings(), mine) == getattr(strategy, theirs)
    # `adjust_steps` of its trainer: int(steps * factor), each for itself.
    for steps in (300, 1000, 3000, 7000, 8700, 29_999, 30_000, 60_000):
        scaled = DensifySettings().scaled(steps)
        for name in ("start", "stop", "every", "reset_every"):
            expected = int(getattr(strategy, names[name]) * (steps / 30_000))
            assert getattr(scaled, name) == max(expected, 1 if "every" in name else 0)
    assert DensifySettings().scaled(10).every == 1


def uniform(count: int, *, scale: float = 0.01, opacity: float = 0.5) -> dict[str, Tensor]:
    values = random_values(count, np.random.default_rng(0))
    values["scales"] = torch.full((count, 3), float(np.log(scale)))
    values["opacities"] = torch.logit(torch.full((count,), opacity))
    return values


def seen(count: int, norm: float = 0.0) -> Observed:
    """Every Gaussian in view with a gradient of this norm in normalised device units."""
    gradient = torch.zeros(count, 2)
    gradient[:, 0] = norm / (WIDTH / 2)
    return Observed(gradient, torch.ones(count, dtype=torch.bool))


@pytest.mark.parametrize(
    ("step", "refines"),
    [(0, False), (500, False), (550, False), (600, True), (14_900, True), (15_000, False)],
)
def test_when_it_refines(step: int, refines: bool) -> None:
    ours = Ours(uniform(3), DensifySettings(), 0)
    did = ours.densify(step, seen(3, norm=1.0))
    assert did.duplicated == (3 if refines else 0)


@pytest.mark.parametrize(
    ("step", "resets"),
    [(0, False), (2999, False), (3000, True), (12_000, True), (15_000, False), (18_000, False)],
)
def test_when_it_resets(step: int, resets: bool) -> None:
    values = uniform(3)
    values["opacities"][0] = -5.5  # below the cap of 0.01: stays
    ours = Ours(values, DensifySettings(start=20_000), 0)
    ours.descend(random_values(3, np.random.default_rng(1)))
    before = ours.gaussians.opacities.detach().clone()
    did = ours.densify(step, seen(3))
    after = torch.sigmoid(ours.gaussians.opacities.detach())
    assert did == (Refinement(reset=2) if resets else Refinement())
    if resets:
        torch.testing.assert_close(after[1:], torch.full((2,), 0.01))
        assert ours.gaussians.opacities[0] == before[0]
    else:
        assert torch.equal(ours.gaussians.opacities, before)


def test_an_average_is_over_the_views_that_saw_it() -> None:
    ours = Ours(uniform(2), DensifySettings(), 0)
    view = Observed(torch.zeros(2, 2), torch.tensor([True, False]))
    ours.densify(1, view)
    ours.densify(2, view)
    # 3e-4 once: a mean of 1e-4 for the first, which three views saw, and of 3e-4 for the second.
    assert ours.densify(600, seen(2, norm=3e-4)).duplicated == 1
    assert torch.equal(ours.gaussians.means[2], ours.gaussians.means[1])


def test_each_rule_is_counted_once() -> None:
    values = uniform(5)
    values["opacities"][:2] = -8.0
    values["scales"][1:3] = 0.0  # 1, above 0.1 scene scales; the second is transparent too
    values["means"][3, 1] = torch.nan
    early, late = (Ours(values, DensifySettings(), 0) for _ in range(2))
    assert early.densify(600, seen(5)) == Refinement(pruned_non_finite=1, pruned_opacity=2)
    did = late.densify(3100, seen(5))
    assert did == Refinement(pruned_non_finite=1, pruned_opacity=2, pruned_scale=1)
    assert torch.equal(late.gaussians.means.detach(), values["means"][4:])


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_what_is_not_finite_is_dropped_and_leaves_no_copies(name: str, value: float) -> None:
    values = uniform(4)
    values[name][2].fill_(value)
    ours = Ours(values, DensifySettings(), 0)
    did = ours.densify(600, seen(4, norm=1.0))
    assert did == Refinement(pruned_non_finite=1, duplicated=3)
    assert all(ours.gaussians[parameter].isfinite().all() for parameter in PARAMETERS)


def test_a_scale_that_overflows_is_dropped() -> None:
    values = uniform(4)
    values["scales"][1, 2] = 89.0  # finite, and exp of it isn't
    ours = Ours(values, DensifySettings(), 0)
    assert ours.densify(600, seen(4)).pruned_non_finite == 1
    assert len(ours.gaussians) == 3


def test_all_pruned_is_a_state_like_others() -> None:
    ours = Ours(uniform(4, opacity=0.001), DensifySettings(), 0)
    ours.descend(uniform(4))
    assert ours.densify(600, seen(4)) == Refinement(pruned_opacity=4)
    assert len(ours.gaussians) == 0
    for step in (601, 700, 3000, 3100):
        ours.descend(uniform(0))
        assert ours.densify(step, seen(0)) == Refinement()
    assert [ours.gaussians[name].shape[0] for name in PARAMETERS] == [0] * 6


def test_a_gradient_that_is_no_number_grows_nothing() -> None:
    ours = Ours(uniform(2), DensifySettings(), 0)
    view = seen(2, norm=1.0)
    view.gradient[0] = torch.nan
    assert ours.densify(600, view).duplicated == 1
    assert ours.densifier.grad2d_sum.isfinite().all()


def test_the_halves_of_a_split_follow_the_old_gaussians_shape() -> None:
    """2 x 4000 halves of a needle: their spread is the needle's own covariance."""
    count = 4000
    values = uniform(count)
    values["means"] = torch.zeros(count, 3)
    values["quats"] = torch.tensor([3.0, 0.0, 0.0, 3.0]).repeat(count, 1)  # x to y, by 90 degrees
    sigma = torch.tensor([0.15, 0.01, 0.03])
    values["scales"] = sigma.log().repeat(count, 1)
    ours = Ours(values, DensifySettings(), 0)
    assert ours.densify(600, seen(count, norm=1.0)).split == count
    covariance = torch.cov(ours.gaussians.means.detach().T)
    expected = torch.diag(sigma[[1, 0, 2]] ** 2)
    torch.testing.assert_close(covariance.diag(), expected.diag(), rtol=0.08, atol=0)
    assert (covariance - covariance.diag().diag()).abs().max() < 0.05 * 0.15 * 0.03
    scales = ours.gaussians.scales.detach().exp()
    torch.testing.assert_close(scales, (sigma / 1.6).repeat(2 * count, 1))


def test_the_same_seed_splits_the_same() -> None:
    runs = [Ours(uniform(30, scale=0.1), DensifySettings(), seed) for seed in (5, 5, 6)]
    for run in runs:
        torch.rand(3)  # the global generator is another
        run.densify(600, seen(30, norm=1.0))
    assert torch.equal(runs[0].gaussians.means, runs[1].gaussians.means)
    assert not torch.equal(runs[0].gaussians.means, runs[2].gaussians.means)


def test_a_view_that_depends_on_no_gaussian_is_not_noted() -> None:
    ours = Ours(uniform(2), DensifySettings(), 0)
    ours.densify(599, seen(2, norm=1.0))
    nothing = torch.zeros(2, dtype=torch.bool)
    done = ours.densifier.after_step(600, None, nothing, width=WIDTH, height=HEIGHT)
    assert done == Refinement(duplicated=2)


def test_statistics_start_again_after_a_refinement() -> None:
    ours = Ours(uniform(2), DensifySettings(grow_grad2d=10.0), 0)
    ours.densify(599, seen(2, norm=1.0))
    assert (ours.densifier.visible_count == 1).all()
    assert (ours.densifier.grad2d_sum == 1).all()
    ours.densify(600, seen(2, norm=1.0))
    assert (ours.densifier.visible_count == 0).all()
    assert (ours.densifier.grad2d_sum == 0).all()
