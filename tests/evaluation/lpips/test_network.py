"""LPIPS against its definition in float64, and against its authors' own package."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from xrgs.evaluation.lpips.network import distance
from xrgs.evaluation.lpips.weights import Weights
from xrgs.photos import images
from xrgs.photos.scenes.scene import bundled_photograph

Array = NDArray[np.float64]


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    first, second = (torch.rand(height, width, 3, generator=generator) for _ in range(2))
    return first, 0.7 * first + 0.3 * second


def tensors(weights: Weights, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array).to(dtype) for name, array in weights.items()}


def convolve(x: Array, weight: Array, bias: Array, stride: int, padding: int) -> Array:
    """Convolve [C, H, W]: every output pixel is a sum over one window."""
    size = weight.shape[-1]
    padded = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = sliding_window_view(padded, (size, size), axis=(1, 2))[:, ::stride, ::stride]
    sums: Array = np.einsum("chwij,ocij->ohw", windows, weight, optimize=True)
    return sums + bias[:, None, None]


#: Stride, padding, and the size of the pooling before, of each convolution; whether its features
#: are compared.
LAYERS = [(4, 2, 0, True), (1, 2, 3, True), (1, 1, 3, True), (1, 1, 0, True), (1, 1, 0, True)]


def by_definition(
    image: Tensor, target: Tensor, weights: Weights, layers: list[tuple[int, int, int, bool]]
) -> float:
    """Zhang et al. 2018, equation 1, with numpy in float64."""
    mean, std = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    pair = [
        (((2 * i.double().numpy() - 1) - mean) / std).transpose(2, 0, 1) for i in (image, target)
    ]
    total, head = 0.0, 0
    for i, (stride, padding, pool, is_compared) in enumerate(layers):
        if pool:
            windows = (sliding_window_view(z, (pool, pool), axis=(1, 2)) for z in pair)
            pair = [window[:, ::2, ::2].max((3, 4)) for window in windows]
        kernel = weights[f"conv{i}.weight"].astype(float), weights[f"conv{i}.bias"].astype(float)
        pair = [np.maximum(convolve(z, *kernel, stride, padding), 0) for z in pair]
        if is_compared:
            unit_x, unit_y = (z / (np.linalg.norm(z, axis=0) + 1e-10) for z in pair)
            squared = (unit_x - unit_y) ** 2
            total += float((squared * weights[f"head{head}"][:, None, None]).sum(0).mean())
            head += 1
    return total


@pytest.mark.parametrize("size", [(31, 31), (64, 87)])
def test_it_is_its_definition(random_weights: Weights, size: tuple[int, int]) -> None:
    image, target = pair(*size)
    expected = by_definition(image, target, random_weights, LAYERS)
    assert expected > 0.1
    exact = distance(image.double(), target.double(), tensors(random_weights, torch.float64))
    assert exact.item() == pytest.approx(expected, rel=1e-12)
    found = distance(image, target, tensors(random_weights))
    assert found.item() == pytest.approx(expected, rel=1e-5)
    assert distance(image, image, tensors(random_weights)) == 0
    for too_small in ((30, 60), (60, 30)):
        with pytest.raises(ValueError, match="px is too small for LPIPS"):
            distance(*pair(*too_small), tensors(random_weights))


def astronaut() -> Tensor:
    return torch.from_numpy(images.read(bundled_photograph("astronaut.png")))[:375, :500]


def blocks(image: Tensor) -> Tensor:
    """Each 5 x 5 px their mean."""
    means = image.double().reshape(75, 5, 100, 5, 3).mean((1, 3)).float()
    return means.repeat_interleave(5, 0).repeat_interleave(5, 1)


@pytest.mark.parametrize(
    ("change", "expected"), [(lambda x: x.flip(1), 0.6977812), (blocks, 0.4876020)]
)
def test_the_published_weights_give_what_the_authors_package_gives(
    published: Weights, change: object, expected: float
) -> None:
    """The numbers are of lpips 0.1.4, its own v0.1 heads, on torchvision 0.28's AlexNet.

    `lpips.LPIPS(net="alex", pnet_rand=True)` with the published backbone put into its five
    convolutions; `net(changed, image, normalize=True)` on [1, 3, 375, 500] float32.
    """
    assert callable(change)
    image = astronaut()
    found = distance(change(image).contiguous(), image, tensors(published))
    assert found.item() == pytest.approx(expected, abs=2e-6)
