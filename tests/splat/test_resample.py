"""Image resampling against torch's own interpolation, on every backend."""

from __future__ import annotations

import itertools
from functools import cache

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
    if backend == "torch":
        torch.testing.assert_close(resize(image, *new), exact, rtol=0, atol=1e-12)
    leaf = image.clone().requires_grad_()
    (exact_gradient,) = torch.autograd.grad(torchs(leaf, new), leaf, slope)
    resized, gradient = value_and_gradient(image.float(), slope.float(), backend)
    for value, expected in ((resized, exact), (gradient, exact_gradient)):
        scale = expected.abs().max().item()
        assert value.shape == expected.shape
        torch.testing.assert_close(value.double(), expected, rtol=0, atol=2e-6 * scale)


def test_one_column_is_resized_as_a_column_of_many(backend: str) -> None:
    # Against a wide image: torch 2.13's interpolate reads one column as if it were something else.
    image = noise(40, 1).float()
    wide = resize(image.expand(-1, 4, -1), 7, 4, backend=backend)
    torch.testing.assert_close(resize(image, 7, 1, backend=backend), wide[:, :1])


def blurred(image: Tensor, size: tuple[int, int], variances: Tensor) -> Tensor:
    """The blur as the exponential of half the second difference, then `resize`."""
    for axis, variance in enumerate(variances):
        count = image.shape[axis]
        steps = torch.eye(count).double().diff(dim=0)  # none across a border: it reflects
        matrix = torch.linalg.matrix_exp(-0.5 * variance * steps.T @ steps)
        image = torch.tensordot(matrix, image, ([1], [axis])).movedim(0, axis)
    return torchs(image, size)


@cache
def blur_and_gradients(
    old: tuple[int, int], new: tuple[int, int], variances: tuple[float, float]
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """`blurred` noise, and the gradients by the image and by the variances, in double."""
    image, slope = noise(*old).requires_grad_(), noise(*new, seed=1) - 0.5
    exact = torch.tensor(variances).double().requires_grad_()
    expected = blurred(image, new, exact)
    return expected.detach(), torch.autograd.grad(expected, (image, exact), slope)


#: Variances down and across, px^2: none, far below 1, a few px, and beyond a small image's borders.
VARIANCES = [(0.0, 0.0), (1e-3, 0.1), (2.9, 18.0), (300.0, 0.5)]
BLURS = [
    *((*size, variances) for size, variances in zip(SIZES, itertools.cycle(VARIANCES))),
    *((*SIZES[2], variances) for variances in VARIANCES),
]


@pytest.mark.parametrize(("old", "new", "variances"), BLURS)
def test_a_blur_of_a_variance_is_the_exponential_of_the_second_difference(
    backend: str, old: tuple[int, int], new: tuple[int, int], variances: tuple[float, float]
) -> None:
    """Its value, and its gradients by the image and by the variances."""
    image, slope = noise(*old), noise(*new, seed=1) - 0.5
    kind = torch.float32 if backend == "native" else torch.float64
    exact = torch.tensor(variances).double()
    leaves = image.to(kind).requires_grad_(), exact.requires_grad_()
    found = resize(leaves[0], *new, variances=leaves[1], backend=backend)
    expected, true_gradients = blur_and_gradients(old, new, variances)
    tolerance = 2e-6 if backend == "native" else 1e-11
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=tolerance)
    gradients = torch.autograd.grad(found, leaves, slope.to(kind))
    for value, truth in zip(gradients, true_gradients, strict=True):
        scale = slope.abs().sum().item() if truth.shape == (2,) else truth.abs().max().item()
        torch.testing.assert_close(value.double(), truth, rtol=0, atol=tolerance * scale)


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


def test_what_does_not_fit_the_kernel_is_refused() -> None:
    native = pytest.importorskip("xrgs._native")
    with pytest.raises(ValueError, match=r"image must be float32 on the CPU.*float64"):
        resize(noise(4, 5), 8, 10, backend="native")
    image, one = torch.zeros(4, 5, 3), torch.ones(2, 2)
    inside = torch.tensor([0, 2], dtype=torch.int32)
    for first in ([0, 4], [-1, 0]):
        outside = torch.tensor(first, dtype=torch.int32)
        with pytest.raises(ValueError, match="a band reaches out of the image"):
            native.resample(image, outside, one, inside, one, 1)
    with pytest.raises(ValueError, match="weights that do not fit"):
        native.resample(image, inside, torch.ones(3, 2), inside, one, 1)
