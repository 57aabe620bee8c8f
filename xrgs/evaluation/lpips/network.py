"""LPIPS with AlexNet, version 0.1 (Zhang et al. 2018), in plain torch: no torchvision."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.nn.functional import conv2d, max_pool2d, relu

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from torch import Tensor

#: What the authors subtract from and divide an image in -1..1 by, a value a channel.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
#: Stride and padding of AlexNet's five convolutions; before the second and third it pools.
_CONVOLUTIONS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
_POOLED = frozenset({1, 2})
_EPS = 1e-10
#: Shorter side, px, of the smallest image that reaches the last layer.
SMALLEST = 31


def distance(image: Tensor, target: Tensor, weights: Mapping[str, Tensor]) -> Tensor:
    """How different two images look: 0 where they are identical, larger is worse.

    Of each layer's rectified features, scaled to unit length over channels, the squared
    difference, weighed by a learned head, averaged over the pixels, summed over the layers.

    Args:
        image: [H, W, 3] in 0..1.
        target: [H, W, 3] in 0..1.
        weights: As `xrgs.evaluation.lpips.weights.load` gives them, in the images' dtype.

    Returns:
        Scalar.

    Raises:
        ValueError: a side is shorter than `SMALLEST`.
    """
    if min(image.shape[:2]) < SMALLEST:
        height, width = image.shape[:2]
        raise ValueError(f"an image of {width} x {height} px is too small for LPIPS")
    both = torch.stack([image, target]).permute(0, 3, 1, 2)  # [2, 3, H, W]
    shift, scale = (both.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
    layers = _features((2 * both - 1 - shift) / scale, weights)
    return torch.stack(
        [_differ(x, weights[f"head{i}"]) for i, x in enumerate(layers)]
    ).sum()  # [5] summed


def _features(x: Tensor, weights: Mapping[str, Tensor]) -> Iterator[Tensor]:
    """AlexNet's five rectified layers of images [N, 3, H, W], each [N, C, h, w]."""
    for i, (stride, padding) in enumerate(_CONVOLUTIONS):
        if i in _POOLED:
            x = max_pool2d(x, kernel_size=3, stride=2)
        x = relu(conv2d(x, weights[f"conv{i}.weight"], weights[f"conv{i}.bias"], stride, padding))
        yield x


def _differ(x: Tensor, head: Tensor) -> Tensor:
    """A layer's share of the distance: features [2, C, h, w], head [C]; a scalar."""
    unit = x / (x.square().sum(1, keepdim=True).sqrt() + _EPS)
    squared = (unit[0] - unit[1]).square()  # [C, h, w]
    return torch.einsum("chw,c->hw", squared, head).mean()
