"""The SSIM of the training loss against kornia and scikit-image."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.ssim import Target

SimilarPair = Callable[..., tuple[Tensor, Tensor]]


def noise(height: int, width: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(height, width, 3, generator=generator, dtype=torch.float64)


def structural_similarity(image: Tensor, target: Target) -> Tensor:
    """The mean SSIM over pixels and channels."""
    return 1 - photometric_loss(image, target, l1=0.0, ssim=1.0, backend="torch")


@pytest.mark.parametrize("size", [(11, 11), (11, 30), (40, 13), (52, 67)])
def test_ssim_is_kornias(similar_pair: SimilarPair, size: tuple[int, int]) -> None:
    from kornia.losses import ssim_loss
    from kornia.metrics import ssim

    image, target = similar_pair(*size)
    batch, reference = (x.permute(2, 0, 1)[None] for x in (image, target))
    # eps: kornia adds it to the denominator.
    expected = ssim(batch, reference, 11, eps=0.0, padding="valid").mean()
    value = structural_similarity(image, prepare_target(target))
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)
    half = ssim_loss(batch, reference, 11, eps=0.0, padding="valid")
    torch.testing.assert_close(1 - value, 2 * half, rtol=1e-12, atol=0)


def test_ssim_is_scikit_images(similar_pair: SimilarPair) -> None:
    from skimage.metrics import structural_similarity as skimage_ssim

    image, target = similar_pair(52, 67)
    # Its mean leaves out the border that the window doesn't fit in.
    expected = skimage_ssim(
        image.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    value = structural_similarity(image, prepare_target(target))
    assert 0.2 < expected < 0.9
    assert value.item() == pytest.approx(expected, rel=1e-10)


@settings(max_examples=25, deadline=None)
@given(
    size=st.tuples(st.integers(11, 24), st.integers(11, 24)),
    seeds=st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)),
)
def test_ssim_is_symmetric_and_bounded(size: tuple[int, int], seeds: tuple[int, int]) -> None:
    a, b = noise(*size, seeds[0]), noise(*size, seeds[1])
    ab = structural_similarity(a, prepare_target(b)).item()
    assert ab == pytest.approx(structural_similarity(b, prepare_target(a)).item(), abs=1e-12)
    assert abs(ab) <= 1 + 1e-12
    assert structural_similarity(a, prepare_target(a)).item() == pytest.approx(1, abs=1e-12)


def test_a_variance_below_zero_counts_as_zero() -> None:
    # At these levels E[x^2] - E[x]^2 in float32 is as often below -C2 as above C2.
    target = prepare_target(torch.ones(12, 15, 3))
    for level in torch.linspace(200, 400, 100):
        image = torch.full((12, 15, 3), level.item())
        luminance = (2 * level + 1e-4) / (level**2 + 1 + 1e-4)
        value = structural_similarity(image, target)
        assert 0 <= value <= 1.2 * luminance


def test_flat_images_have_the_ssim_of_their_levels() -> None:
    image, target = torch.full((2, 12, 15, 3), 0.0, dtype=torch.float64)
    image, target = image + 0.25, target + 0.5
    expected = (2 * 0.25 * 0.5 + 1e-4) / (0.25**2 + 0.5**2 + 1e-4)
    value = structural_similarity(image, prepare_target(target)).item()
    assert value == pytest.approx(expected, rel=1e-9)
