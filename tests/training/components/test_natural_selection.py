"""GNS: a common push on all opacities, and what fades under it is removed down to the budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.conftest import composed as compose
from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Step
from xrgs.training.components.natural_selection import NaturalSelection
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train

STOP, UNTIL = 15_000, 23_000


@pytest.fixture
def selection(build: Build, off: ComponentsConf) -> NaturalSelection:
    """Keeps 3 Gaussians; the finest view has 60 x 75 px."""
    off.natural_selection.budget = 3.4 / (60 * 75)
    (component,) = build(off)
    assert isinstance(component, NaturalSelection)
    return component


@pytest.fixture
def at(hr: Step) -> Callable[[int], Step]:
    """(number) -> the step of that number of 30,000, with an empty log."""
    return lambda number: replace(hr, number=number, log={})


def with_opacities(gaussians: Gaussians, *opacities: float) -> Gaussians:
    """The six Gaussians with these opacities, and gradients of +-2 on their logits."""
    gaussians.opacities = torch.tensor(opacities).logit().requires_grad_()
    gaussians.opacities.grad = torch.tensor([2.0, -2.0, 2.0, -2.0, 2.0, -2.0])
    return gaussians


def pushed(selection: NaturalSelection, gaussians: Gaussians, step: Step) -> float:
    """What is added to the gradient of every logit opacity at a step; it must be the same."""
    assert gaussians.opacities.grad is not None
    before = gaussians.opacities.grad.clone()
    selection.after_backward(gaussians, step)
    added = gaussians.opacities.grad - before
    torch.testing.assert_close(added, added[:1].expand(len(added)))
    gaussians.opacities.grad = before
    return added[0].item()


def indices(mask: Tensor | None) -> list[int]:
    return [] if mask is None else torch.nonzero(mask)[:, 0].tolist()


def test_the_push_is_the_mean_gradient_and_follows_the_path(
    selection: NaturalSelection, gaussians: Gaussians, at: Callable[[int], Step]
) -> None:
    """With a budget of 3, the third most opaque must live; it is to fall from 0.8 x 0.5 to 0."""
    six = with_opacities(gaussians, 0.1, 0.9, 0.2, 0.5, 0.3, 0.7)
    assert pushed(selection, six, at(STOP - 1)) == 0
    assert pushed(selection, six, at(STOP)) == 2
    assert pushed(selection, six, at(STOP + 99)) == 2
    # Half way to 22,000 the path is at 0.2; the tolerance is a tenth of it.
    half_way = (STOP + UNTIL - 1_000) // 2
    for opacity, factor in ((0.5, 1.2), (0.23, 1.2), (0.21, 1), (0.19, 1), (0.17, 0.8)):
        before = selection.push
        six = with_opacities(gaussians, 0.01, 0.9, 0.02, opacity, 0.03, 0.7)
        assert pushed(selection, six, at(half_way + 1)) == pytest.approx(before)
        assert pushed(selection, six, at(half_way)) == pytest.approx(before * factor)
    # From there on the goal is 0, and everything is above it.
    assert pushed(selection, six, at(UNTIL - 900)) == pytest.approx(selection.push)
    before = selection.push
    assert pushed(selection, six, at(UNTIL - 800)) == pytest.approx(before * 1.2)


def test_it_is_the_same_push_in_a_short_run(
    selection: NaturalSelection, gaussians: Gaussians, hr: Step
) -> None:
    six = with_opacities(gaussians, 0.1, 0.9, 0.2, 0.5, 0.3, 0.7)
    pushes = [pushed(selection, six, replace(hr, number=n, total=300)) for n in range(149, 154)]
    # Every step is 100 nominal steps, and the path is at 0.394 and less, where the opacity is 0.5.
    assert pushes == pytest.approx([0, 2, 2.4, 2.88, 3.456])


def test_what_has_faded_is_removed_every_50_steps_down_to_the_budget(
    selection: NaturalSelection, gaussians: Gaussians, at: Callable[[int], Step]
) -> None:
    six = with_opacities(gaussians, 0.0009, 0.9, 0.0011, 0.5, 0.0008, 0.7)
    assert selection.to_prune(six, at(STOP - 50)) is None
    assert indices(selection.to_prune(six, at(STOP + 50))) == [0, 4]
    assert indices(selection.to_prune(six, at(STOP + 51))) == []
    selection.drop_every = 500
    assert selection.to_prune(six, at(STOP + 450)) is None
    assert indices(selection.to_prune(six, at(STOP + 500))) == [0, 4]
    # Five have faded, and three of the six must go: the most transparent ones.
    six = with_opacities(gaussians, 0.0009, 0.9, 0.0005, 0.0006, 0.0007, 0.0008)
    assert indices(selection.to_prune(six, at(STOP + 1000))) == [2, 3, 4]


def test_at_the_end_the_most_transparent_are_removed(
    selection: NaturalSelection, gaussians: Gaussians, at: Callable[[int], Step]
) -> None:
    six = with_opacities(gaussians, 0.3, 0.9, 0.2, 0.5, 0.1, 0.2)
    assert indices(selection.to_prune(six, at(UNTIL + 7))) == [2, 4, 5]
    assert selection.done
    assert pushed(selection, six, at(UNTIL + 8)) == 0
    assert selection.to_prune(six, at(UNTIL + 50)) is None


def test_within_5_percent_of_the_budget_the_rest_goes_at_once(
    build: Build, off: ComponentsConf, at: Callable[[int], Step]
) -> None:
    off.natural_selection.budget = 100.4 / (60 * 75)
    for count, removed in ((106, 0), (105, 5), (101, 1), (100, 0), (50, 0)):
        (selection,) = build(off)
        many = Gaussians(*[torch.zeros(count)] * 6)
        many.opacities = torch.linspace(0, 1, count)
        faded = indices(selection.to_prune(many, at(STOP + 1)))
        assert faded == list(range(removed))


@pytest.mark.slow
def test_a_run_ends_with_the_budget(data: Dataset) -> None:
    # Without resets, which would leave no more than the budget, and with a rate of the opacities at
    # which they can fade in 16 steps.
    without_resets = ("train.steps=60", "splat.backend=auto", "splat.densify.reset_every=50000")
    over = (*without_resets, "splat.optimizer.opacities=0.8")
    result = train(data, compose(*over, "components.natural_selection.budget=0.01"))
    assert len(result.gaussians) == 36 == round(0.01 * 60 * 60)
    at_stop = [row["gaussians"] for row in result.history if row["step"] <= 30]
    assert max(at_stop) > 2 * 36
    # The push fades opacities before anything is removed at once, at step 46.
    faded = [row["pruned_by_components"] for row in result.history if row["step"] < 46]
    assert faded[-1] > 0
