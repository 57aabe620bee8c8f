"""Backward passes are skipped where a view's loss fits its mean, and nothing else changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from tests.conftest import composed as compose
from tests.training.conftest import same
from xrgs.config import ComponentsConf, Conf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Component, Components, Step
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train

Build = Callable[..., Components]


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    """Steps may be skipped from the first one on."""
    off.skip_backward.share, off.skip_backward.begin = 0.25, 0
    return off


def _needs(component: Components, step: Step, *losses: float) -> list[bool]:
    return [
        component.needs_backward(torch.tensor(loss, dtype=torch.float64), step) for loss in losses
    ]


def test_a_loss_above_the_running_mean_needs_a_backward_pass(
    build: Build, on: ComponentsConf, hr: Step
) -> None:
    on.skip_backward.share = 0.0
    losses, means = [1.0, 0.9, 0.997, 0.99, 2.0, 1.04], [1.0]
    for loss in losses[1:]:
        means.append(0.95 * means[-1] + 0.05 * loss)
    expected = [True] + [loss > mean for loss, mean in zip(losses[1:], means[:-1], strict=True)]
    assert expected == [True, False, True, False, True, False]
    assert _needs(build(on), hr, *losses) == expected


def test_the_tolerance_is_relative_to_the_mean(build: Build, on: ComponentsConf, hr: Step) -> None:
    on.skip_backward.share, on.skip_backward.tolerance = 0.0, 0.1
    on.skip_backward.decay = 0.0  # the mean is the loss before
    assert _needs(build(on), hr, 2.0, 2.19, 2.42, 2.6) == [True, False, True, False]


def test_each_view_has_a_mean_of_its_own(
    build: Build, on: ComponentsConf, hr: Step, lr: Step
) -> None:
    on.skip_backward.share = 0.0
    parts = build(on)
    assert _needs(parts, hr, 1.0) + _needs(parts, lr, 5.0) == [True, True]
    assert _needs(parts, hr, 2.0) + _needs(parts, lr, 4.0) == [True, False]


@pytest.mark.parametrize(("share", "count"), [(0.25, 100), (0.5, 200), (0.9, 360)])
def test_the_least_share_of_steps_has_a_backward_pass(
    build: Build, on: ComponentsConf, hr: Step, share: float, count: int
) -> None:
    on.skip_backward.share = share
    needed = _needs(build(on), hr, *(1.0 for _ in range(400)))  # every loss fits
    assert sum(needed) == count
    for done in range(1, 401):  # and not just in the end
        assert sum(needed[:done]) >= share * done - 1e-9


def test_steps_before_the_beginning_are_not_counted(
    build: Build, off: ComponentsConf, hr: Step
) -> None:
    off.skip_backward.share = 0.5
    parts = build(off)
    early, late = replace(hr, number=14_999, log={}), replace(hr, number=15_000, log={})
    assert _needs(parts, early, 3.0, 2.0, 1.0) == [True] * 3  # the baseline's densify.stop
    assert early.log == {}
    assert _needs(parts, late, 1.0) == [True]  # no mean yet
    assert late.log == {"skip_backward.HR": 0.0}


def test_a_loss_that_is_not_finite_needs_a_backward_pass(
    build: Build, on: ComponentsConf, hr: Step
) -> None:
    on.skip_backward.share = 0.0
    assert _needs(build(on), hr, math.nan, 1.0, math.inf, math.nan, 0.5) == [
        True,
        True,
        True,
        True,
        False,
    ]


class Counter(Component):
    """Answers that no backward pass is needed at some steps, and counts the calls of the hooks."""

    def __init__(self, skipped: set[int]) -> None:
        self.skipped = skipped
        self.calls: dict[str, list[int]] = {"asked": [], "backward": [], "densify": []}

    def needs_backward(self, loss: torch.Tensor, step: Step) -> bool:
        assert loss.ndim == 0
        self.calls["asked"].append(step.number)
        return step.number not in self.skipped

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        assert gaussians.means.grad is not None
        self.calls["backward"].append(step.number)

    def densification_grad2d(self, grad2d: torch.Tensor, step: Step) -> torch.Tensor:
        self.calls["densify"].append(step.number)
        return grad2d


def test_a_skipped_step_has_no_update_and_every_component_is_asked(
    data: Dataset, short: Conf
) -> None:
    first, second = Counter({3, 4}), Counter({4, 7})
    result = train(data, short, extra_components=[first, second])
    done = [step for step in range(short.train.steps) if step not in {3, 4, 7}]
    assert first.calls["asked"] == second.calls["asked"] == list(range(short.train.steps))
    assert first.calls["backward"] == first.calls["densify"] == done
    totals = [row["skipped_backward"] for row in result.history[:9]]
    assert totals == [0, 0, 0, 1, 2, 2, 2, 3, 3]


def test_without_a_skipped_step_the_history_has_no_such_column(data: Dataset, short: Conf) -> None:
    assert "skipped_backward" not in train(data, short).history[-1]


def test_the_last_steps_can_be_left_out(data: Dataset, short: Conf) -> None:
    """Training whose last 20 steps are all skipped ends with what it had after 20 steps."""
    seen: list[Gaussians] = []

    def look(gaussians: Gaussians) -> dict[str, float | None]:
        seen.append(gaussians)
        return {}

    short.splat.densify.stop, short.train.evaluate_every = 0, 20
    result = train(data, short, extra_components=[Counter(set(range(20, 40)))], evaluate=look)
    assert same(result.gaussians, seen[0])
    assert not same(train(data, short).gaussians, seen[0])


def test_training_skips_at_most_what_the_share_allows(data: Dataset) -> None:
    conf = compose("train.steps=40", "splat.backend=auto", "+ablation=skip_backward")
    skipped = train(data, conf).history[-1]["skipped_backward"]
    assert 0 < skipped <= 10  # half of the 20 steps after densification
    assert isinstance(conf.components.skip_backward.begin, int)
