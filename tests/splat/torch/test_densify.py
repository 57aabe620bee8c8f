"""The densification statistics in closed form."""

from __future__ import annotations

import math

import torch

from xrgs.splat.torch.densify import accumulate_statistics


def test_norms_are_in_normalised_device_units() -> None:
    gradient = torch.tensor([[3.0, 4.0], [0.0, 0.0], [torch.nan, 1.0]], dtype=torch.float64)
    visible = torch.tensor([True, True, False])
    grad2d_sum = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    visible_count = torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64)
    accumulate_statistics(gradient, visible, (2.0, 0.5), grad2d_sum, visible_count)
    assert grad2d_sum.tolist() == [1 + math.hypot(6.0, 2.0), 2.0, 3.0]
    assert visible_count.tolist() == [6.0, 7.0, 7.0]
