"""Image resampling against torch's own interpolation, on every backend."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from tests.splat.scenes import noise
from xrgs.splat.resample import resize

#: (from, to), [H, W]: up and down, one axis each way, the same, one pixel, whole vectors and not.
SIZES = [
    ((15, 20), (75, 100)),
    ((75, 100), (15, 20)),
    ((33, 47), (21, 90)),
    ((16, 16), (16, 16)),
    ((18, 31), (18, 31)),
    ((1, 1), (5, 7)),
    ((5, 7), (1, 1)),
    ((1, 40), (3, 8)),
    ((97, 129), (4, 6)),
]


def torchs(image: Tensor, size: tuple[int, int]) -> Tensor:
    planes = image.permute(2, 0, 1)[None]
    resized = interpolate(planes, size=size, mode="bicubic", antialias=True)
    return resized[0].permute(1, 2, 0)


def value_and_gradient(image: Tensor, slope: Tensor, backend: str) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    resized = resize(leaf, slope.shape[0], slope.shape[1], backend=backend)
    (gradient,) = torch.autograd.grad(resized, leaf, slope)
    return resized.detach(), gradient


@pytest.mark.parametrize(("old", "new"), SIZES)
def test_it_is_torchs_interpolation(
    backend: str, old: tuple[int, int], new: tuple[int, int]
) -> None:
    image, slope = noise(*old), noise(*new, seed=1) - 0.5
    exact = torchs(image, new)
    leaf = image.clone().requires_grad_()
    (exact_gradient,) = torch.autograd.grad(torchs(leaf, new), leaf, slope)
    resized, gradient = value_and_gradient(image.float(), slope.float(), backend)
    for value, expected in ((resized, exact), (gradient, exact_gradient)):
        scale = expected.abs().max().item()
        assert value.shape == expected.shape
        torch.testing.assert_close(value.double(), expected, rtol=0, atol=2e-6 * scale)


@pytest.mark.parametrize(("old", "new"), SIZES)
def test_in_double_it_is_exact(old: tuple[int, int], new: tuple[int, int]) -> None:
    image = noise(*old)
    torch.testing.assert_close(resize(image, *new), torchs(image, new), rtol=0, atol=1e-12)


def test_one_column_is_resized_as_a_column_of_many(backend: str) -> None:
    # Against a wide image: torch 2.13's interpolate reads one column as if it were something else.
    image = noise(40, 1).float()
    wide = resize(image.expand(-1, 4, -1), 7, 4, backend=backend)
    torch.testing.assert_close(resize(image, 7, 1, backend=backend), wide[:, :1])


@pytest.mark.parametrize(
    ("shape", "size", "message"),
    [
        ((4, 5), (8, 10), r"image must be \[H, W, 3\]"),
        ((4, 5, 4), (8, 10), r"image must be \[H, W, 3\]"),
        ((0, 5, 3), (8, 10), r"H and W above 0, got \[0, 5, 3\]"),
        ((4, 5, 3), (0, 10), "height and width must be at least 1, got 0 and 10"),
    ],
)
def test_wrong_sizes_are_named(shape: tuple[int, ...], size: tuple[int, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        resize(torch.zeros(shape), *size)
