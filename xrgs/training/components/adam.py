"""Adam for parameters that components learn for each view, one row at each step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8
"""The decay rates, and the constant in the denominator: torch's defaults."""
_STATE = ("values", "first", "second", "updates")


class RowAdam:
    """Adam [kingma2015] with its own moments and step count for each row of a tensor.

    Attributes:
        values: The rows [R, ...], in float64, so that updates do not depend on the processor.
    """

    def __init__(self, values: Tensor) -> None:
        """Start with a copy of the rows [R, ...]."""
        self.values = values.double().clone()
        self.first, self.second = torch.zeros_like(self.values), torch.zeros_like(self.values)
        """First and second moments of the gradients [R, ...]."""
        self.updates = torch.zeros(len(values), dtype=torch.int64)
        """Number of updates of each row [R]."""

    def update(self, at: int, gradient: Tensor, rate: float) -> None:
        """Update row `at` by its gradient [...], float64."""
        self.updates[at] += 1
        count = int(self.updates[at])
        first, second = self.first[at], self.second[at]
        first += (1 - _BETA1) * (gradient - first)
        second += (1 - _BETA2) * (gradient * gradient - second)
        spread = (second / (1 - _BETA2**count)).sqrt() + _EPS
        self.values[at] -= rate / (1 - _BETA1**count) * first / spread

    def state_dict(self) -> dict[str, Any]:
        """Return the rows, their moments and their numbers of updates."""
        return {name: getattr(self, name) for name in _STATE}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        for name in _STATE:
            getattr(self, name).copy_(state[name])
