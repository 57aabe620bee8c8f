"""Roots, means and norms that do not depend on the processor or on the number of threads.

torch's roots of float32 are those of the library that it was built with, which rounds otherwise on
other processors, and the order in which torch adds depends on the number of threads as well. In
double that changes the last digits alone, and rounding removes these again: the functions below
compute in double and round to the type of their argument.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rounded_sqrt(values: Tensor) -> Tensor:
    """Return the square root of each value, correctly rounded where the values are float32.

    Args:
        values: A floating tensor of any shape, 0 or above.

    Returns:
        A tensor of the same shape and type, differentiable where the values are above 0.
    """
    return torch.sqrt(values.double()).to(values.dtype)


def rounded_mean(values: Tensor) -> float:
    """Return the mean of all values.

    Args:
        values: A floating tensor of any shape.
    """
    return values.detach().mean(dtype=torch.float64).to(values.dtype).item()


def rounded_norm(values: Tensor) -> float:
    """Return the root of the sum of the squares of all values.

    Args:
        values: A floating tensor of any shape.
    """
    norm = torch.linalg.vector_norm(values.detach(), dtype=torch.float64)
    rounded: float = norm.to(values.dtype).item()
    return rounded
