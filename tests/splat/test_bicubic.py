"""The matrix of antialiased bicubic resampling."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import interpolate

from xrgs.splat.bicubic import bicubic_matrix

SIZES = [(20, 100), (100, 20), (7, 7), (1, 5), (101, 33)]


@pytest.mark.parametrize(("old", "new"), SIZES)
def test_rows_sum_to_one(old: int, new: int) -> None:
    ones = torch.ones(new, dtype=torch.float64)
    torch.testing.assert_close(bicubic_matrix(old, new).sum(dim=1), ones, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("old", "new"), SIZES)
def test_the_product_is_torchs_interpolation(old: int, new: int) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 1, old, 4, generator=generator, dtype=torch.float64)
    expected = interpolate(image, size=(new, 4), mode="bicubic", antialias=True)[0, 0]
    product = bicubic_matrix(old, new) @ image[0, 0]
    torch.testing.assert_close(product, expected, rtol=0, atol=1e-12)
