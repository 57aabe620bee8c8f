"""The activation functions of the raw parameters in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def exp(x: Tensor) -> Tensor:
    """Return e^x: scales of their natural logarithms.

    Args:
        x: A tensor of any shape.

    Returns:
        A tensor of the same shape and type, differentiable.
    """
    return torch.exp(x)


def logistic(x: Tensor) -> Tensor:
    """Return 1 / (1 + e^-x): opacities of their logits.

    Args:
        x: A tensor of any shape.

    Returns:
        A tensor of the same shape and type, differentiable.
    """
    return torch.sigmoid(x)
