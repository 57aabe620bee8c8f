"""The compiled loss against the torch one in double, whose own tests are in ../test_loss.py."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import similar_pair
from xrgs.splat.loss import photometric_loss, prepare_target

pytest.importorskip("xrgs._native")

native_loss = partial(photometric_loss, l1=0.8, ssim=0.2, backend="native")


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    image, photograph = similar_pair(height, width)
    return image.float(), photograph.float()


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


@pytest.mark.parametrize("size", [(11, 11), (13, 32), (131, 65), (43, 400)])  # a strip has 512
def test_a_photograph_has_the_moments_of_the_torch_backend(isa: str, size: tuple[int, int]) -> None:
    """The same bits: `Target` is then the same whatever the backend."""
    _, photograph = pair(*size)
    photograph[:3] = 0.3  # flat: the variance is rounding, or 0
    photograph[4:6] += 1e4
    photograph[-1, -1, 2] = float("nan")
    expected = prepare_target(photograph)
    target = prepare_target(
        photograph.permute(2, 0, 1).contiguous().permute(1, 2, 0), backend="native"
    )
    assert expected.variance[..., 2].isnan().any()
    for name in ("image", "mean", "variance"):
        same = partial(torch.testing.assert_close, rtol=0, atol=0, equal_nan=True)
        same(getattr(target, name), getattr(expected, name))


@pytest.mark.parametrize(
    ("size", "l1", "ssim", "weighted"),
    [  # sizes around the window, the vectors (16 floats), the groups of rows and chunks of columns
        ((11, 11), 0.8, 0.2, False),
        ((11, 11), 0.8, 0.2, True),
        ((11, 30), 1.0, 0.0, False),
        ((40, 13), 0.0, 1.0, True),
        ((12, 16), 0.3, 2.0, False),
        ((13, 32), 0.8, 0.2, True),
        ((52, 67), 0.0, 1.0, False),
        ((33, 64), 1.0, 0.0, True),
        ((75, 133), 0.8, 0.2, False),
        ((131, 65), 0.3, 2.0, True),
    ],
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
    without = native_loss(image, prepare_target(photograph), l1=l1, ssim=ssim, pixel_weight=weight)
    assert without.item() == loss
    assert not without.requires_grad


def test_types_are_checked() -> None:
    image, photograph = pair(20, 24)
    target, weight = prepare_target(photograph), torch.ones(20, 24)
    with pytest.raises(ValueError, match="image must be float32"):
        native_loss(image.double(), target)
    with pytest.raises(ValueError, match="image must be float32"):
        prepare_target(photograph.double(), backend="native")
    with pytest.raises(ValueError, match="target must be float32"):
        native_loss(image, prepare_target(photograph.double()))
    with pytest.raises(ValueError, match="pixel_weight must be float32"):
        native_loss(image, target, pixel_weight=weight.double())
    with pytest.raises(ValueError, match="pixel_weight must not require a gradient"):
        native_loss(image, target, pixel_weight=weight.requires_grad_())
