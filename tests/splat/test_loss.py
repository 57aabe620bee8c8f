"""The photometric loss against its formula, scikit-image and finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.torch.loss import dissimilarity_map

SimilarPair = Callable[..., tuple[Tensor, Tensor]]


def noise(height: int, width: int, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize(("l1", "ssim"), [(0.8, 0.2), (1.0, 0.0), (0.0, 1.0), (0.3, 2.0)])
def test_the_loss_is_its_formula(similar_pair: SimilarPair, l1: float, ssim: float) -> None:
    image, photograph = similar_pair(20, 24)
    target = prepare_target(photograph)
    absolute = np.abs(image.numpy() - photograph.numpy()).mean()
    dissimilarity = dissimilarity_map(image, target).mean().item()
    loss = photometric_loss(image, target, l1=l1, ssim=ssim).item()
    assert loss == pytest.approx(l1 * absolute + ssim * dissimilarity, rel=1e-12)


def test_gradients_are_those_of_finite_differences(similar_pair: SimilarPair) -> None:
    image, photograph = similar_pair(13, 12)
    target = prepare_target(photograph)
    image.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, target, l1=0.8, ssim=0.2), image, rtol=1e-6, atol=1e-9
    )


def test_float32_is_float64_rounded(similar_pair: SimilarPair) -> None:
    image, photograph = similar_pair(52, 67)
    results = []
    for dtype in (torch.float32, torch.float64):
        x = image.to(dtype).requires_grad_()
        loss = photometric_loss(x, prepare_target(photograph.to(dtype)), l1=0.8, ssim=0.2)
        torch.autograd.backward(loss)
        assert loss.dtype == dtype
        assert x.grad is not None
        results.append((loss.item(), x.grad.double()))
    (loss32, grad32), (loss64, grad64) = results
    assert loss32 == pytest.approx(loss64, rel=1e-6)
    # Where |image - target| is within rounding of 0 its sign, and L1's gradient, may differ.
    certain = (image - photograph).abs() > 1e-6
    torch.testing.assert_close(
        grad32[certain], grad64[certain], rtol=1e-4, atol=1e-4 * grad64.abs().max().item()
    )


@pytest.mark.parametrize(
    ("level", "texture", "difference"),
    [(0.5, 0.3, 1e-3), (0.97, 1e-3, 1e-4), (0.0, 1e-3, 1e-4)],
)
def test_ssim_keeps_its_digits_near_convergence(
    almost_equal: Callable[[float, float, float], tuple[Tensor, Tensor]],
    level: float,
    texture: float,
    difference: float,
) -> None:
    results = []
    for dtype in (torch.float32, torch.float64):
        image, photograph = (x.to(dtype) for x in almost_equal(level, texture, difference))
        image.requires_grad_()
        loss = photometric_loss(image, prepare_target(photograph), l1=0.0, ssim=1.0)
        torch.autograd.backward(loss)
        assert image.grad is not None
        results.append((loss.item(), image.grad.double()))
    (loss32, grad32), (loss64, grad64) = results
    assert loss32 == pytest.approx(loss64, rel=1e-6)
    assert (grad32 - grad64).norm() <= 1e-6 * grad64.norm()


@settings(max_examples=50, deadline=None)
@given(
    levels=st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 2),
    noisy=st.booleans(),
)
def test_flat_images_stay_finite(levels: tuple[float, float], noisy: bool) -> None:
    # E[x^2] - E[x]^2 of a flat image is often below 0 in float32.
    image = torch.full((12, 15, 3), levels[0]).requires_grad_()
    photograph = torch.full((12, 15, 3), levels[1]) + noisy * noise(12, 15, 0, torch.float32)
    target = prepare_target(photograph)
    assert (target.variance >= 0).all()
    loss = photometric_loss(image, target, l1=0.8, ssim=0.2)
    torch.autograd.backward(loss)
    assert image.grad is not None
    assert loss.isfinite()
    assert image.grad.isfinite().all()


def test_a_strided_image_counts_the_same(similar_pair: SimilarPair) -> None:
    image, photograph = similar_pair(20, 24)
    target = prepare_target(photograph)
    planar = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not planar.is_contiguous()
    loss = photometric_loss(image, target, l1=0.8, ssim=0.2)
    torch.testing.assert_close(
        photometric_loss(planar, target, l1=0.8, ssim=0.2), loss, rtol=1e-12, atol=0
    )


def test_a_target_keeps_no_graph() -> None:
    target = prepare_target(noise(12, 12, 0).requires_grad_())
    assert not any(x.requires_grad for x in (target.image, target.mean, target.variance))


def test_an_image_of_the_windows_size_has_one_window() -> None:
    assert prepare_target(torch.zeros(11, 11, 3)).mean.shape == (1, 1, 3)


@pytest.mark.parametrize("size", [(10, 30), (30, 10), (1, 1)])
def test_an_image_smaller_than_the_window_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"{size[1]} x {size[0]} px.*11 px"):
        prepare_target(torch.zeros(*size, 3))


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"image must be \[H, W, 3\], got \[20, 20\]"):
        prepare_target(torch.zeros(20, 20))
    with pytest.raises(ValueError, match=r"image is \[20, 21, 3\], its target \[20, 20, 3\]"):
        photometric_loss(
            torch.zeros(20, 21, 3), prepare_target(torch.zeros(20, 20, 3)), l1=1, ssim=0
        )


# --- a weight for each pixel --------------------------------------------------------------------


@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_one_weight_for_every_pixel_weighs_the_loss(
    similar_pair: SimilarPair, weight: float
) -> None:
    image, photograph = similar_pair(20, 24)
    target = prepare_target(photograph)
    plain = photometric_loss(image, target, l1=0.8, ssim=0.2).item()
    weights = torch.full((20, 24), weight, dtype=torch.float64)
    weighted = photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=weights).item()
    assert weighted == pytest.approx(weight * plain, rel=1e-12)


@pytest.mark.parametrize(("l1", "ssim"), [(0.8, 0.2), (1.0, 0.0), (0.0, 1.0)])
def test_the_weighted_loss_is_its_formula(
    similar_pair: SimilarPair, l1: float, ssim: float
) -> None:
    from skimage.metrics import structural_similarity as skimage_ssim

    image, photograph = similar_pair(20, 24)
    weights = noise(20, 24, seed=9)[..., 0]
    _, similarity = skimage_ssim(
        image.numpy(),
        photograph.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    w = weights.numpy()
    absolute = (w[..., None] * np.abs(image.numpy() - photograph.numpy())).mean()
    lacking = (w[5:-5, 5:-5, None] * (1 - similarity[5:-5, 5:-5])).mean()
    target = prepare_target(photograph)
    loss = photometric_loss(image, target, l1=l1, ssim=ssim, pixel_weight=weights).item()
    assert loss == pytest.approx(l1 * absolute + ssim * lacking, rel=1e-9)


def test_a_pixel_without_weight_has_no_gradient(similar_pair: SimilarPair) -> None:
    image, photograph = similar_pair(30, 40)
    weights = torch.ones(30, 40, dtype=torch.float64)
    weights[:, :20] = 0
    image.requires_grad_()
    target = prepare_target(photograph)
    torch.autograd.backward(photometric_loss(image, target, l1=0.8, ssim=0.2, pixel_weight=weights))
    assert image.grad is not None
    assert (image.grad[:, :15] == 0).all()  # beyond the windows around pixels with weight
    assert (image.grad[:, 20:] != 0).all()


def test_gradients_of_the_weighted_loss_are_those_of_finite_differences(
    similar_pair: SimilarPair,
) -> None:
    image, photograph = similar_pair(13, 12)
    target, weights = prepare_target(photograph), noise(13, 12, seed=4)[..., 0]
    image.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, target, l1=0.8, ssim=0.2, pixel_weight=weights),
        image,
        rtol=1e-6,
        atol=1e-9,
    )


def test_a_weight_map_of_another_size_is_refused(similar_pair: SimilarPair) -> None:
    image, photograph = similar_pair(13, 12)
    with pytest.raises(ValueError, match=r"pixel_weight must be \[13, 12\] .*got \[12, 13\]"):
        photometric_loss(
            image, prepare_target(photograph), l1=1, ssim=1, pixel_weight=torch.ones(12, 13)
        )
