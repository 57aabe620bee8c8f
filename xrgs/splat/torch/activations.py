"""The activation functions of the raw parameters in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.gaussians import ActivatedGaussians


def exp(x: Tensor) -> Tensor:
    """Return e^x: scales from their natural logarithms."""
    return torch.exp(x)


def logistic(x: Tensor) -> Tensor:
    """Return 1 / (1 + e^-x): opacities from their logits."""
    return torch.sigmoid(x)


def activate(scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Return `exp(scales)` and `logistic(opacities)`."""
    return torch.exp(scales), torch.sigmoid(opacities)


def activated(raw: ActivatedGaussians) -> ActivatedGaussians:
    """Apply the activation functions to raw Gaussians (log scales, logit opacities)."""
    scales, opacities = activate(raw.scales, raw.opacities)
    return raw._replace(scales=scales, opacities=opacities)
