"""Means and norms that do not depend on the number of threads.

torch adds in an order that depends on the number of threads and on the processor. In double that
changes the last digits of a sum, which rounding to float32 removes again.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rounded_mean(values: Tensor) -> float:
    """Return the mean of all values, rounded to their type.

    Args:
        values: A tensor of any shape.
    """
    return values.detach().mean(dtype=torch.float64).to(values.dtype).item()


def rounded_norm(values: Tensor) -> float:
    """Return the root of the sum of the squares of all values, rounded to their type.

    Args:
        values: A tensor of any shape.
    """
    norm = torch.linalg.vector_norm(values.detach(), dtype=torch.float64)
    return norm.to(values.dtype).item()
