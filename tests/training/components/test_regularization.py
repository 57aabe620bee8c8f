"""The penalties of 3DGS-MCMC, in float64."""

from __future__ import annotations

import pytest
import torch

from tests.splat.scenes import noise
from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Step
from xrgs.training.components.regularization import Regularization


@pytest.mark.parametrize(("opacity", "scale"), [(0.01, 0.0), (0.0, 0.02), (0.01, 0.02)])
def test_the_means_are_added_to_the_loss(
    opacity: float, scale: float, backend: str, off: ComponentsConf, lr: Step, gaussians: Gaussians
) -> None:
    off.regularization.opacity, off.regularization.scale = opacity, scale
    gaussians.opacities.grad = gaussians.scales.grad = None
    loss = Regularization(off.regularization, backend).modify_loss(
        torch.tensor(0.25), noise(4, 4), gaussians, lr
    )
    torch.autograd.backward(loss)

    logits, logs = (
        value.detach().double().requires_grad_()
        for value in (gaussians.opacities, gaussians.scales)
    )
    means = {"opacity": torch.sigmoid(logits).mean(), "scale": torch.exp(logs).mean()}
    expected = 0.25 + opacity * means["opacity"] + scale * means["scale"]
    torch.autograd.backward(expected)
    assert loss.dtype == torch.float32
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)
    for weight, own, exact in (
        (opacity, gaussians.opacities, logits),
        (scale, gaussians.scales, logs),
    ):
        if weight:
            assert own.grad is not None
            assert exact.grad is not None
            torch.testing.assert_close(own.grad.double(), exact.grad, rtol=1e-6, atol=0)
        else:
            assert own.grad is None
    weights = {"opacity": opacity, "scale": scale}
    assert lr.log == {
        f"regularization.{name}": pytest.approx(means[name].item(), rel=1e-6)
        for name, weight in weights.items()
        if weight
    }


def test_the_weight_of_lr_views_leaves_the_penalties_alone(
    build: Build, off: ComponentsConf, lr: Step, gaussians: Gaussians
) -> None:
    losses = []
    for weight in (1.0, 0.25):
        off.loss_weighting.lr_weight, off.regularization.opacity = weight, 0.5
        image = lr.view.image
        losses.append(build(off).modify_loss(torch.tensor(1.0), image, gaussians, lr).item())
    assert losses[0] - losses[1] == pytest.approx(0.75, rel=1e-6)
