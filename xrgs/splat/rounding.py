"""Roots, means and norms with the same bits on every processor and for any number of threads.

The last digits of torch's roots depend on the processor, and those of its sums also on the number
of threads. The functions below compute in double, where only digits below float32's precision
differ, and round to the dtype of the argument.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rounded_sqrt(values: Tensor) -> Tensor:
    """Return the square root of each value, correctly rounded if the values are float32."""
    return torch.sqrt(values.double()).to(values.dtype)


def rounded_mean(values: Tensor) -> float:
    """Return the mean of all values."""
    return values.detach().mean(dtype=torch.float64).to(values.dtype).item()


def rounded_norm(values: Tensor) -> float:
    """Return the Euclidean norm of all values."""
    norm = torch.linalg.vector_norm(values.detach(), dtype=torch.float64)
    rounded: float = norm.to(values.dtype).item()
    return rounded
