"""The activation functions of plain torch in closed form."""

from __future__ import annotations

import math

import torch

from xrgs.splat.torch import activations


def test_values() -> None:
    x = torch.tensor([-1.5, 0.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(activations.exp(x).tolist(), [math.exp(v) for v in x.tolist()])
    logistic = [1 / (1 + math.exp(-v)) for v in x.tolist()]
    torch.testing.assert_close(activations.logistic(x).tolist(), logistic)
