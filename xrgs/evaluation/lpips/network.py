"""LPIPS, version 0.1, in plain torch: torchvision is not needed.

Source: [zhang2018], and the authors' package `lpips`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from xrgs.evaluation.lpips.weights import ALEX, Network

#: The authors' normalisation of an image in -1..1: mean and standard deviation of each channel.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPS = 1e-10


def distance(
    image: Tensor, target: Tensor, weights: Mapping[str, Tensor], network: Network = ALEX
) -> Tensor:
    """Compute the perceptual distance of two images [zhang2018, equation 1].

    The rectified features of each compared layer are normalised to unit length over the channels.
    Their squared differences are weighted per channel by the trained linear heads, averaged over
    the pixels, and summed over the layers. The images are [H, W, 3] in 0..1; the tensors `weights`,
    in their dtype, have the names of `xrgs.evaluation.lpips.weights.from_bytes`.

    Returns:
        A scalar, 0 for identical images.

    Raises:
        ValueError: A side is shorter than `network.min_side`.
    """
    if min(image.shape[:2]) < network.min_side:
        height, width = image.shape[:2]
        raise ValueError(f"an image of {width} x {height} px is too small for LPIPS")
    both = torch.stack([image, target]).permute(0, 3, 1, 2)  # [2, 3, H, W]
    shift, scale = (both.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
    layers = _features((2 * both - 1 - shift) / scale, weights, network)
    return torch.stack(
        [_layer_distance(x, weights[f"head{i}"]) for i, x in enumerate(layers)]
    ).sum()  # [5] summed


def _features(x: Tensor, weights: Mapping[str, Tensor], network: Network) -> Iterator[Tensor]:
    """Yield the compared layers, each [N, C, h, w], of images [N, 3, H, W]."""
    for i, (stride, padding) in enumerate(network.convolutions):
        if i in network.pooled:
            x = max_pool2d(x, kernel_size=network.pool_size, stride=2)
        x = relu(conv2d(x, weights[f"conv{i}.weight"], weights[f"conv{i}.bias"], stride, padding))
        if i in network.compared:
            yield x


def _layer_distance(x: Tensor, head: Tensor) -> Tensor:
    """Compute a layer's term from both images' features [2, C, h, w] and the head [C]."""
    unit = x / (x.square().sum(1, keepdim=True).sqrt() + _EPS)
    squared = (unit[0] - unit[1]).square()  # [C, h, w]
    return torch.einsum("chw,c->hw", squared, head).mean()
