"""phi against torch's own interpolation, natively too, and its gradient against its transpose."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import interpolate

from xrgs.splat.bicubic import bicubic_matrix
from xrgs.splat.resample import resize

NATIVE = importlib.util.find_spec("xrgs._native") is not None
needs_native = pytest.mark.skipif(not NATIVE, reason="the native backend was not built")

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


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(height, width, 3, generator=generator, dtype=torch.float64)


def torchs(image: Tensor, size: tuple[int, int]) -> Tensor:
    planes = image.permute(2, 0, 1)[None]
    resized = interpolate(planes, size=size, mode="bicubic", antialias=True)
    return resized[0].permute(1, 2, 0)


def value_and_gradient(image: Tensor, slope: Tensor, backend: str) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    resized = resize(leaf, slope.shape[0], slope.shape[1], backend=backend)
    (gradient,) = torch.autograd.grad(resized, leaf, slope)
    return resized.detach(), gradient


@pytest.fixture
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """`torch`, or `native` on one of the machine's instruction sets."""
    if request.param == "torch":
        yield "torch"
        return
    from xrgs import _native

    before = _native.isa()
    _native.set_isa(request.param)
    yield "native"
    _native.set_isa(before)


def backends() -> list[str]:
    if not NATIVE:
        return ["torch"]
    from xrgs import _native

    return ["torch", *_native.available_isas()]


@pytest.mark.parametrize("backend", backends(), indirect=True)
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


@pytest.mark.parametrize("backend", backends(), indirect=True)
def test_one_column_is_resized_as_a_column_of_many(backend: str) -> None:
    # Against a wide image: torch 2.13's interpolate reads one column as if it were something else.
    image = noise(40, 1).float()
    wide = resize(image.expand(-1, 4, -1), 7, 4, backend=backend)
    torch.testing.assert_close(resize(image, 7, 1, backend=backend), wide[:, :1])


side = st.integers(1, 70)


@needs_native
@settings(max_examples=60, deadline=None)
@given(old=st.tuples(side, side), new=st.tuples(side, side), seed=st.integers(0, 10**6))
def test_the_gradient_is_by_the_transpose(
    old: tuple[int, int], new: tuple[int, int], seed: int
) -> None:
    image, slope = noise(*old, seed).float(), noise(*new, seed + 1).float() - 0.5
    resized, gradient = value_and_gradient(image, slope, "native")
    torch.testing.assert_close(
        resized.double(), resize(image.double(), *new), rtol=0, atol=1e-6 * 3
    )
    # <phi x, y> = <x, phi^T y>, and by how much the terms of the two sums may be off.
    forth = (resized.double() * slope.double()).sum().item()
    back = (image.double() * gradient.double()).sum().item()
    terms = (resized.double() * slope.double()).abs().sum().item()
    terms += (image.double() * gradient.double()).abs().sum().item()
    assert abs(forth - back) <= 1e-6 * terms


@needs_native
@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(("old", "new"), [((75, 100), (375, 500)), ((131, 60), (33, 17))])
def test_threads_change_no_bit(isa: str, old: tuple[int, int], new: tuple[int, int]) -> None:
    image, slope = noise(*old).float(), noise(*new, seed=1).float()
    results = []
    for count in (1, 2, 3, 4, 1):
        torch.set_num_threads(count)
        results.append(value_and_gradient(image, slope, "native"))
    for resized, gradient in results[1:]:
        assert torch.equal(resized, results[0][0])
        assert torch.equal(gradient, results[0][1])


@needs_native
def test_any_strides_will_do() -> None:
    planes = noise(3, 20).expand(-1, -1, 3).permute(2, 1, 0).float()  # [3, 20, 3] of odd strides
    assert not planes.is_contiguous()
    slope = torch.ones(1, 1, 3).expand(9, 40, 3)
    one = value_and_gradient(planes, slope, "native")
    other = value_and_gradient(planes.contiguous(), slope.contiguous(), "native")
    assert torch.equal(one[0], other[0])
    assert torch.equal(one[1], other[1])


@needs_native
def test_what_is_not_finite_stays_where_it_is() -> None:
    image = noise(20, 30).float()
    image[10, 15] = torch.nan
    resized = resize(image, 100, 150, backend="native")
    assert resized[45:60, 70:85].isnan().any()
    assert resized[:35].isfinite().all()
    assert resized[:, 100:].isfinite().all()


def test_rows_of_the_matrix_sum_to_one() -> None:
    for old, new in ((20, 100), (100, 20), (7, 7), (1, 5), (101, 33)):
        torch.testing.assert_close(
            bicubic_matrix(old, new).sum(dim=1),
            torch.ones(new, dtype=torch.float64),
            rtol=0,
            atol=1e-12,
        )


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


@needs_native
def test_the_native_one_is_for_float32() -> None:
    with pytest.raises(ValueError, match=r"image must be float32 on the CPU.*float64"):
        resize(noise(4, 5), 8, 10, backend="native")


@needs_native
def test_bands_out_of_the_image_are_refused() -> None:
    from xrgs import _native

    image, one = torch.zeros(4, 5, 3), torch.ones(2, 2)
    inside = torch.tensor([0, 2], dtype=torch.int32)
    for first in ([0, 4], [-1, 0]):
        outside = torch.tensor(first, dtype=torch.int32)
        with pytest.raises(ValueError, match="a band reaches out of the image"):
            _native.resample(image, outside, one, inside, one, 1)
    with pytest.raises(ValueError, match="weights that do not fit"):
        _native.resample(image, inside, torch.ones(3, 2), inside, one, 1)
