"""The photometric loss against its formula, scikit-image, finite differences and float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.splat.scenes import noise, similar_pair
from xrgs.splat.loss import (
    photometric_loss,
    prepare_target,
    window_moments,
)


@pytest.mark.parametrize(
    ("l1", "ssim", "weighted"), [(0.8, 0.2, False), (0.0, 1.0, False), (0.3, 2.0, True)]
)
def test_the_loss_is_its_formula(l1: float, ssim: float, weighted: bool) -> None:
    from skimage.metrics import structural_similarity as skimage_ssim

    image, photograph = similar_pair(20, 24)
    weights = noise(20, 24, seed=9)[..., 0] if weighted else None
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
    w = np.ones((20, 24)) if weights is None else weights.numpy()
    absolute = (w[..., None] * np.abs(image.numpy() - photograph.numpy())).mean()
    lacking = (w[5:-5, 5:-5, None] * (1 - similarity[5:-5, 5:-5])).mean()
    target = prepare_target(photograph)
    loss = photometric_loss(image, target, l1=l1, ssim=ssim, pixel_weight=weights).item()
    assert loss == pytest.approx(l1 * absolute + ssim * lacking, rel=1e-10)


@pytest.mark.parametrize("weighted", [False, True])
def test_gradients_are_those_of_finite_differences(weighted: bool) -> None:
    image, photograph = similar_pair(13, 12)
    weights = noise(13, 12, seed=4)[..., 0] if weighted else None
    target = prepare_target(photograph)
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, target, l1=0.8, ssim=0.2, pixel_weight=weights),
        image.requires_grad_(),
        rtol=1e-6,
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("level", "texture", "difference"),
    [(0.5, 0.3, 1e-3), (0.97, 1e-3, 1e-4), (0.0, 1e-3, 1e-4)],
)
def test_ssim_keeps_its_digits_near_convergence(
    backend: str, level: float, texture: float, difference: float
) -> None:
    """The photograph is noise of height `texture`, and the render is above it by other noise."""
    random = torch.rand(2, 60, 70, 3, generator=torch.Generator().manual_seed(0))
    photograph = level + texture * random[0]
    render = photograph + difference * random[1]
    results = []
    for dtype, of in ((torch.float32, backend), (torch.float64, "torch")):
        image, target = render.to(dtype).requires_grad_(), prepare_target(photograph.to(dtype))
        loss = photometric_loss(image, target, l1=0.0, ssim=1.0, backend=of)
        (gradient,) = torch.autograd.grad(loss, image)
        results.append((loss.item(), gradient.double()))
    (loss32, grad32), (loss64, grad64) = results
    assert loss32 == pytest.approx(loss64, rel=1e-6)
    assert (grad32 - grad64).norm() <= 1e-6 * grad64.norm()


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    levels=st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 2),
    noisy=st.booleans(),
)
def test_flat_images_stay_finite(backend: str, levels: tuple[float, float], noisy: bool) -> None:
    # E[x^2] - E[x]^2 of a flat image is often below 0 in float32.
    image = torch.full((12, 15, 3), levels[0]).requires_grad_()
    photograph = torch.full((12, 15, 3), levels[1]) + noisy * noise(12, 15).float()
    target = prepare_target(photograph, backend=backend)
    assert (target.variance >= 0).all()
    loss = photometric_loss(image, target, l1=0.8, ssim=0.2, backend=backend)
    (gradient,) = torch.autograd.grad(loss, image)
    assert loss.isfinite()
    assert gradient.isfinite().all()


def test_wrong_shapes_are_refused() -> None:
    target = prepare_target(torch.zeros(20, 24, 3))
    with pytest.raises(ValueError, match=r"image must be \[H, W, 3\], got \[20, 20\]"):
        prepare_target(torch.zeros(20, 20))
    for height, width in ((10, 30), (30, 10)):
        with pytest.raises(ValueError, match=f"{width} x {height} px.*11 px"):
            prepare_target(torch.zeros(height, width, 3))
    with pytest.raises(ValueError, match=r"image is \[20, 21, 3\], its target \[20, 24, 3\]"):
        photometric_loss(torch.zeros(20, 21, 3), target, l1=1, ssim=0)
    image, weight = torch.zeros(20, 24, 3), torch.ones(24, 20)
    with pytest.raises(ValueError, match=r"pixel_weight must be \[20, 24\] .*got \[24, 20\]"):
        photometric_loss(image, target, l1=1, ssim=1, pixel_weight=weight)


@pytest.mark.parametrize("height", [42, 43, 100])
def test_a_target_has_the_moments_of_the_whole_image(height: int) -> None:
    """It computes them in blocks of rows, and in double."""
    image = noise(height, 15, seed=height).float()
    target = prepare_target(image)
    mean, variance = window_moments(image.double())
    assert torch.equal(target.mean, mean.float())
    assert torch.equal(target.variance, variance.float())


def test_a_variance_below_zero_counts_as_zero() -> None:
    # At these levels E[x^2] - E[x]^2 in float32 is as often below -C2 as above C2.
    target = prepare_target(torch.ones(12, 15, 3))
    for level in torch.linspace(200, 400, 100):
        image = torch.full((12, 15, 3), level.item())
        luminance = (2 * level + 1e-4) / (level**2 + 1 + 1e-4)
        value = 1 - photometric_loss(image, target, l1=0.0, ssim=1.0)
        assert 0 <= value <= 1.2 * luminance
