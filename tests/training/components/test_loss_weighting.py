"""Section 5.2: the whole loss of an LR view is weighted, and with it its gradients."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Components, Step

#: The losses of these tests do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)


@pytest.fixture
def weighting(build: Callable[..., Components], off: ComponentsConf) -> Components:
    off.loss_weighting.lr_weight = 0.25
    return build(off)


def test_the_loss_of_an_lr_view_is_weighted(weighting: Components, hr: Step, lr: Step) -> None:
    loss = torch.tensor(0.8)
    assert weighting.modify_loss(loss, lr.view.image, NO_GAUSSIANS, lr) == 0.2
    assert weighting.modify_loss(loss, hr.view.image, NO_GAUSSIANS, hr) is loss
    assert (lr.log, hr.log) == ({"weighting.LR": 0.25}, {})


def test_its_gradients_are_weighted_with_it(weighting: Components, lr: Step) -> None:
    x = torch.tensor(3.0, requires_grad=True)
    torch.autograd.backward(weighting.modify_loss(x * 2, lr.view.image, NO_GAUSSIANS, lr))
    assert x.grad == 0.5


def test_densification_reads_the_weighted_gradient(
    weighting: Components, hr: Step, lr: Step
) -> None:
    gradient = torch.rand(4, 2)
    assert weighting.densification_grad2d(gradient, lr) is gradient
    assert weighting.densification_grad2d(gradient, hr) is gradient


def test_unweighted_densification_reads_the_gradient_without_the_weight(
    build: Callable[..., Components], off: ComponentsConf, hr: Step, lr: Step
) -> None:
    off.loss_weighting.lr_weight, off.loss_weighting.stat_from = 0.25, "unweighted"
    weighting = build(off)
    means2d = torch.rand(4, 2, requires_grad=True)
    plain = (means2d**2).sum()
    (expected,) = torch.autograd.grad(plain, means2d, retain_graph=True)
    for step in (lr, hr):
        (found,) = torch.autograd.grad(
            weighting.modify_loss(plain, step.view.image, NO_GAUSSIANS, step),
            means2d,
            retain_graph=True,
        )
        assert torch.equal(found, expected) == (step is hr)
        assert torch.equal(weighting.densification_grad2d(found, step), expected)


def test_a_weight_of_0_is_not_divided_by(
    build: Callable[..., Components], off: ComponentsConf, lr: Step
) -> None:
    off.loss_weighting.lr_weight, off.loss_weighting.stat_from = 0.0, "unweighted"
    gradient = torch.zeros(4, 2)
    assert torch.equal(build(off).densification_grad2d(gradient, lr), gradient)


def test_an_unknown_statistic_is_refused(
    build: Callable[..., Components], off: ComponentsConf
) -> None:
    off.loss_weighting.lr_weight, off.loss_weighting.stat_from = 0.25, "both"
    with pytest.raises(XrgsError, match=r"^components\.loss_weighting\.stat_from=both"):
        build(off)
