"""Backward passes are skipped where a view's loss fits its mean."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from examples.arms.tests.conftest import with_arms
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.training.components import Components, Step
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs_arms.skip_backward import Settings, SkipBackward

Build = Callable[..., Components]


def skipping(**settings: float) -> SkipBackward:
    """Return the component with steps skipped from the first one on."""
    return SkipBackward(Settings(**{"share": 0.0, "begin": 0, **settings}))  # type: ignore[arg-type]


def _needs(component: SkipBackward | Components, step: Step, *losses: float) -> list[bool]:
    return [
        component.needs_backward(torch.tensor(loss, dtype=torch.float64), step) for loss in losses
    ]


def test_a_loss_above_the_running_mean_needs_a_backward_pass(hr: Step, lr: Step) -> None:
    losses, means = [1.0, 0.9, 0.997, 0.99, 2.0, 1.04], [1.0]
    for loss in losses[1:]:
        means.append(0.95 * means[-1] + 0.05 * loss)
    expected = [True] + [loss > mean for loss, mean in zip(losses[1:], means[:-1], strict=True)]
    assert expected == [True, False, True, False, True, False]
    assert _needs(skipping(), hr, *losses) == expected
    last = skipping(tolerance=0.1, decay=0.0)  # the mean is the loss before
    assert _needs(last, hr, 2.0, 2.19, 2.42, 2.6) == [True, False, True, False]
    each = skipping()  # a mean for each view
    assert _needs(each, hr, 1.0) + _needs(each, lr, 5.0) == [True, True]
    assert _needs(each, hr, 2.0) + _needs(each, lr, 4.0) == [True, False]


@pytest.mark.parametrize(("share", "count"), [(0.25, 100), (0.9, 360)])
def test_the_least_share_of_steps_has_a_backward_pass(hr: Step, share: float, count: int) -> None:
    needed = _needs(skipping(share=share), hr, *(1.0 for _ in range(400)))  # every loss fits
    assert sum(needed) == count
    for done in range(1, 401):  # and not just in the end
        assert sum(needed[:done]) >= share * done - 1e-9


def test_steps_before_the_beginning_are_not_counted(
    build: Build, off: ComponentsConf, hr: Step
) -> None:
    off.plugins["skip_backward"] = {"share": 0.5}
    parts = build(off)
    early, late = replace(hr, number=14_999, log={}), replace(hr, number=15_000, log={})
    assert _needs(parts, early, 3.0, 2.0, 1.0) == [True] * 3  # the baseline's densify.stop
    assert early.log == {}
    assert _needs(parts, late, 1.0) == [True]  # no mean yet
    assert late.log == {"skip_backward.HR": 0.0}


def test_a_loss_that_is_not_finite_needs_a_backward_pass(hr: Step) -> None:
    assert _needs(skipping(), hr, math.nan, 1.0, math.inf, math.nan, 0.5) == [
        True,
        True,
        True,
        True,
        False,
    ]


def test_training_skips_at_most_what_the_share_allows(data: Dataset) -> None:
    conf = with_arms("train.steps=40", "splat.backend=auto", "+ablation=skip_backward")
    skipped = train(data, conf).history[-1]["skipped_backward"]
    assert 0 < skipped <= 10  # half of the 20 steps after densification


@pytest.mark.parametrize(
    "setting",
    [{"share": 1.1}, {"decay": 1.0}, {"tolerance": -0.1}],
)
def test_a_value_out_of_range_names_its_key(
    setting: dict[str, float], build: Build, off: ComponentsConf
) -> None:
    off.plugins["skip_backward"] = {"share": 0.5} | setting
    ((name, value),) = setting.items()
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.skip_backward\.{name}={value}"):
        build(off)
    off.plugins["skip_backward"] = {"share": 1.0}
    assert build(off) == ()
