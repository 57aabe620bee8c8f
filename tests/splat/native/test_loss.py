"""The compiled loss against the torch one in double, whose own tests are in test_loss.py."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import interpolate

from xrgs.splat.loss import photometric_loss, prepare_target

native = pytest.importorskip("xrgs._native")

native_loss = partial(photometric_loss, l1=0.8, ssim=0.2, backend="native")


def pair(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two float32 images of the same smooth shapes, each with noise of its own."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 8 + 2, width // 8 + 2, generator=generator)
    smooth = interpolate(coarse, size=(height, width), mode="bicubic")[0].permute(1, 2, 0)
    noise = torch.rand(2, height, width, 3, generator=generator)
    image, photograph = smooth + 0.1 * noise
    return image, photograph


def value_and_gradient(
    image: Tensor,
    photograph: Tensor,
    backend: str,
    *,
    l1: float = 0.8,
    ssim: float = 0.2,
    weight: Tensor | None = None,
) -> tuple[float, Tensor]:
    leaf = image.clone().requires_grad_()
    target = prepare_target(photograph)
    loss = photometric_loss(leaf, target, l1=l1, ssim=ssim, pixel_weight=weight, backend=backend)
    torch.autograd.backward(loss)
    assert leaf.grad is not None
    return loss.item(), leaf.grad


def random_weights(height: int, width: int) -> Tensor:
    """Weights in 0..1 of the pixels, a third of which are 0."""
    weight = torch.rand(height, width, generator=torch.Generator().manual_seed(7))
    return torch.where(weight < 1 / 3, 0.0, weight)


FUSED = [name for name in native.available_isas() if name != "portable"]

# Sizes around the window, the vectors (16 floats), the groups of rows and the chunks of columns.
SIZES = [(11, 11), (11, 30), (40, 13), (12, 16), (13, 32), (52, 67), (33, 64), (75, 133), (131, 65)]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("size", [*SIZES, (43, 400)])  # more than one strip of 512 floats
def test_a_photograph_has_the_moments_of_the_torch_backend(
    isa: str, size: tuple[int, int], threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bits: `Target` is then the same whatever the backend."""
    _, photograph = pair(*size)
    photograph[:3] = 0.3  # flat: the variance is rounding, or 0
    photograph[4:6] += 1e4
    photograph[-1, -1, 2] = float("nan")
    expected = prepare_target(photograph)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    target = prepare_target(
        photograph.permute(2, 0, 1).contiguous().permute(1, 2, 0), backend="native"
    )
    assert expected.variance[..., 2].isnan().any()
    for name in ("image", "mean", "variance"):
        same = partial(torch.testing.assert_close, rtol=0, atol=0, equal_nan=True)
        same(getattr(target, name), getattr(expected, name))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("l1", "ssim", "weighted"),
    [(0.8, 0.2, False), (0.8, 0.2, True), (1.0, 0.0, False), (0.0, 1.0, True), (0.3, 2.0, False)],
)
def test_it_is_the_torch_loss_in_double(
    isa: str, size: tuple[int, int], l1: float, ssim: float, weighted: bool
) -> None:
    image, photograph = pair(*size)
    weight = random_weights(*size) if weighted else None
    if weight is not None:
        weight[size[0] // 2, size[1] // 2] = 3.0  # so that the only window of 11 x 11 px counts
    exact, exact_gradient = value_and_gradient(
        image.double(),
        photograph.double(),
        "torch",
        l1=l1,
        ssim=ssim,
        weight=None if weight is None else weight.double(),
    )
    loss, gradient = value_and_gradient(
        image, photograph, "native", l1=l1, ssim=ssim, weight=weight
    )
    assert loss == pytest.approx(exact, rel=1e-6)
    assert gradient.shape == image.shape
    error = (gradient.double() - exact_gradient).abs().max()
    assert error <= 2e-6 * exact_gradient.abs().max()


@settings(max_examples=25)
@given(size=st.tuples(st.integers(11, 60), st.integers(11, 90)), seed=st.integers(0, 10**6))
def test_any_size(size: tuple[int, int], seed: int) -> None:
    image, photograph = pair(*size, seed)
    exact, exact_gradient = value_and_gradient(image.double(), photograph.double(), "torch")
    loss, gradient = value_and_gradient(image, photograph, "native")
    assert loss == pytest.approx(exact, abs=1e-6)
    # Where the two images are within rounding of one another L1's gradient may have either sign.
    certain = (image - photograph).abs() > 1e-7
    torch.testing.assert_close(
        gradient.double()[certain],
        exact_gradient[certain],
        rtol=0,
        atol=2e-5 * exact_gradient.abs().max().item(),
    )


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("weighted", [False, True])
# At the last size torch's own sums depend on the number of threads for some images.
@pytest.mark.parametrize("size", [(11, 40), (257, 33), (200, 300)])
def test_threads_change_no_bit(isa: str, size: tuple[int, int], weighted: bool) -> None:
    image, photograph = pair(*size)
    weight = random_weights(*size) if weighted else None
    results = []
    for count in (1, 2, 3, 4, 1):
        torch.set_num_threads(count)
        results.append(value_and_gradient(image, photograph, "native", weight=weight))
    for loss, gradient in results[1:]:
        assert loss == results[0][0]
        assert torch.equal(gradient, results[0][1])


@pytest.fixture
def restored_isa() -> Iterator[None]:
    """Restores the instruction set after the test."""
    before = native.isa()
    yield
    native.set_isa(before)


@pytest.mark.usefixtures("restored_isa")
@pytest.mark.skipif(len(FUSED) < 2, reason="needs two instruction sets with fused multiply-adds")
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("size", [(11, 11), (52, 67), (131, 65)])
def test_instruction_sets_with_fma_give_the_same_bits(
    size: tuple[int, int], weighted: bool
) -> None:
    image, photograph = pair(*size)
    weight = random_weights(*size) if weighted else None
    results = []
    for name in FUSED:
        native.set_isa(name)
        results.append(value_and_gradient(image, photograph, "native", weight=weight))
    for loss, gradient in results[1:]:
        assert loss == results[0][0]
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize("levels", [(0.0, 0.0), (1.0, 0.0), (0.25, 0.5), (3.0, 3.0), (-700.0, 1e4)])
def test_flat_images_stay_finite(isa: str, levels: tuple[float, float]) -> None:
    image, photograph = (torch.full((25, 31, 3), level) for level in levels)
    exact, _ = value_and_gradient(image.double(), photograph.double(), "torch")
    loss, gradient = value_and_gradient(image, photograph, "native")
    assert gradient.isfinite().all()
    # A variance beside C2: sums over eleven taps down and eleven across round 22 times.
    spread = max(abs(level - 0.5) for level in levels)
    assert loss == pytest.approx(exact, rel=1e-6, abs=0.2 * 22 * 2**-24 * spread**2 / 0.03**2)


def test_the_same_image_has_neither_loss_nor_gradient(isa: str) -> None:
    image, _ = pair(40, 50)
    loss, gradient = value_and_gradient(image, image, "native")
    assert loss == 0
    assert (gradient == 0).all()


@pytest.mark.parametrize("where", [(0, 0, 0), (20, 13, 2), (29, 40, 1)])
def test_nan_shows(isa: str, where: tuple[int, int, int]) -> None:
    image, photograph = pair(30, 41)
    image[where] = float("nan")
    loss, gradient = value_and_gradient(image, photograph, "native")
    assert math.isnan(loss)
    assert gradient[where].isnan()
    # A window reaches ten pixels, and only its own channel.
    y, x, channel = where
    rows, columns = (torch.arange(n) for n in (30, 41))
    far = ((rows - y).abs() > 10)[:, None] | ((columns - x).abs() > 10)[None]
    assert gradient[far].isfinite().all()
    assert gradient[..., [c for c in range(3) if c != channel]].isfinite().all()


def test_nan_in_the_target_shows() -> None:
    image, photograph = pair(30, 41)
    photograph[3, 4, 1] = float("nan")
    loss, gradient = value_and_gradient(image, photograph, "native")
    assert math.isnan(loss)
    assert gradient[3, 4, 1].isnan()


def test_strided_tensors_count_the_same() -> None:
    image, photograph = pair(20, 24)
    weight, target = random_weights(20, 24), prepare_target(photograph)
    planar, planar_photograph = (
        value.permute(2, 0, 1).contiguous().permute(1, 2, 0) for value in (image, photograph)
    )
    strided = weight.t().contiguous().t()
    assert not planar.is_contiguous()
    assert not strided.is_contiguous()
    expected = native_loss(image, target, pixel_weight=weight)
    assert torch.equal(native_loss(planar, target, pixel_weight=strided), expected)
    other = native_loss(image, prepare_target(planar_photograph), pixel_weight=weight)
    torch.testing.assert_close(other, expected, rtol=1e-7, atol=0)


def test_weighted_and_summed_losses_add_up() -> None:
    image, first = pair(20, 24)
    _, second = pair(20, 24, seed=1)
    _, by_first = value_and_gradient(image, first, "native")
    _, by_second = value_and_gradient(image, second, "native")
    leaf = image.clone().requires_grad_()
    losses = [native_loss(leaf, prepare_target(p)) for p in (first, second, first)]
    total = losses[0] + 0.25 * losses[1] + losses[2]
    torch.autograd.backward(total, retain_graph=True)
    assert leaf.grad is not None
    expected = 2 * by_first + 0.25 * by_second
    torch.testing.assert_close(leaf.grad, expected, rtol=1e-6, atol=1e-9)
    torch.autograd.backward(total)  # what the first time gave out must still be there
    torch.testing.assert_close(leaf.grad, 2 * expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("weighted", [False, True])
def test_an_image_without_gradient_has_the_same_loss(isa: str, weighted: bool) -> None:
    image, photograph = pair(30, 41)
    weight = random_weights(30, 41) if weighted else None
    loss, _ = value_and_gradient(image, photograph, "native", weight=weight)
    value = native_loss(image, prepare_target(photograph), pixel_weight=weight)
    assert value.item() == loss
    assert not value.requires_grad


def test_types_and_shapes_are_checked() -> None:
    image, photograph = pair(20, 24)
    target = prepare_target(photograph)
    with pytest.raises(ValueError, match="image must be float32"):
        native_loss(image.double(), target)
    with pytest.raises(ValueError, match="image must be float32"):
        prepare_target(photograph.double(), backend="native")
    with pytest.raises(ValueError, match="target must be float32"):
        native_loss(image, prepare_target(photograph.double()))
    with pytest.raises(ValueError, match=r"image is \[19, 24, 3\], its target \[20, 24, 3\]"):
        native_loss(image[:19], target)
    with pytest.raises(ValueError, match="pixel_weight must be float32"):
        native_loss(image, target, pixel_weight=torch.ones(20, 24, dtype=torch.float64))
    with pytest.raises(ValueError, match="pixel_weight must not require a gradient"):
        native_loss(image, target, pixel_weight=torch.ones(20, 24, requires_grad=True))
    with pytest.raises(ValueError, match=r"pixel_weight must be \[20, 24\] .*got \[24, 20\]"):
        native_loss(image, target, pixel_weight=torch.ones(24, 20))


# --- a weight for each pixel --------------------------------------------------------------------


def test_a_weight_of_nan_shows(isa: str) -> None:
    image, photograph = pair(30, 41)
    weight = torch.ones(30, 41)
    weight[20, 13] = float("nan")
    loss, gradient = value_and_gradient(image, photograph, "native", weight=weight)
    assert math.isnan(loss)
    assert gradient[20, 13].isnan().all()
    assert gradient[:10].isfinite().all()
