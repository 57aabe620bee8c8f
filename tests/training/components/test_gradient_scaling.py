"""Section 5.3: only the gradient of the log-scales changes, and only in LR views."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.training.components import Components, Step


@pytest.fixture
def scaling(build: Build, off: ComponentsConf) -> Components:
    off.gradient_scaling.lr_scale = 0.3
    return build(off)


@pytest.mark.parametrize(("tag", "factor"), [("LR", 0.3), ("HR", 1.0)])
def test_only_the_scales_gradient_is_scaled(
    tag: str,
    factor: float,
    scaling: Components,
    steps: dict[str, Step],
    gaussians: Gaussians,
    gradients: dict[str, Tensor],
) -> None:
    scaling.after_backward(gaussians, steps[tag])
    assert set(gradients) == set(PARAMETERS)
    for name, before in gradients.items():
        after = gaussians[name].grad
        assert after is not None
        assert torch.equal(after, before * (factor if name == "scales" else 1.0)), name
    assert (gradients["scales"] != 0).all()
    norm = gradients["scales"].norm().item()
    assert steps[tag].log == {f"gradient_scaling.norm_{tag}": pytest.approx(norm)}
