"""Paper 5.2: the whole loss of an LR view is weighted, and with it its gradients."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from xrgs.components import Components, Step
from xrgs.config import ComponentsConf


@pytest.fixture
def weighting(build: Callable[..., Components], off: ComponentsConf) -> Components:
    off.loss_weighting.lr_weight = 0.25
    return build(off)


def test_the_loss_of_an_lr_view_is_weighted(weighting: Components, hr: Step, lr: Step) -> None:
    loss = torch.tensor(0.8)
    assert weighting.loss(loss, lr.view.image, lr) == 0.2
    assert weighting.loss(loss, hr.view.image, hr) is loss


def test_its_gradients_are_weighted_with_it(weighting: Components, lr: Step) -> None:
    x = torch.tensor(3.0, requires_grad=True)
    weighting.loss(x * 2, lr.view.image, lr).backward()
    assert x.grad == 0.5
