"""The choice between the implementations of the model: compiled kernels, plain torch, or gsplat.

`native` and `torch` run on the CPU. `gsplat` runs on a GPU: `gsplat.rasterization` renders, and the
functions of `torch` do the rest. This module imports torch only for `gsplat`, so that planning a
study stays quick.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
import os
from importlib import metadata
from types import ModuleType
from typing import Literal

from xrgs.errors import XrgsError
from xrgs.splat.settings import RasterSettings

NATIVE_MODULE = "xrgs._native"
CHOICES = ("auto", "native", "torch", "gsplat")
REQUIRE_NATIVE = "XRGS_REQUIRE_NATIVE"
DEVICES = {"native": "cpu", "torch": "cpu", "gsplat": "cuda"}
"""Device of each backend's tensors."""
_GSPLAT_ALPHA_MAX = {"1.5.3": 0.999, "1.6": 0.99}
"""Supported versions of gsplat -> the cap of alpha in the kernels of each."""

Operation = Literal["elementwise", "loss", "optimizer", "rasterizer", "resample"]
"""A module of `xrgs/splat/torch/` and `xrgs/splat/native/`; `xrgs/splat/gsplat/` has only the
rasterizer."""


def resolve_backend(name: str) -> str:
    """Choose the backend on this machine for a configured name.

    Args:
        name: `native`, `torch`, `gsplat`, or `auto`. `auto` means native if the extension was
            built. If not, `auto` means torch and logs one warning, or fails if the environment
            variable XRGS_REQUIRE_NATIVE is 1.

    Returns:
        `native`, `torch` or `gsplat`.

    Raises:
        ValueError: The name is unknown.
        XrgsError: The native backend is configured or required, and was not built; or gsplat is
            configured, and is missing or of an unsupported version.
    """
    if name not in CHOICES:
        raise ValueError(f"backend must be one of {', '.join(CHOICES)}, got {name!r}")
    if name == "torch":
        return "torch"
    if name == "gsplat":
        _gsplat_version()
        return "gsplat"
    if importlib.util.find_spec(NATIVE_MODULE) is not None:
        return "native"
    if name == "native":
        raise XrgsError(f"splat.backend=native: {NATIVE_MODULE} was not built on this machine")
    if os.environ.get(REQUIRE_NATIVE) == "1":
        raise XrgsError(f"{REQUIRE_NATIVE}=1, and {NATIVE_MODULE} was not built on this machine")
    _warn_once()
    return "torch"


def implementation(operation: Operation, backend: str) -> ModuleType:
    """Return the module that implements an operation; it is imported at the first call.

    The modules of an operation have functions of the same names and parameters in all backends. The
    backend gsplat has only `rasterizer`; its other operations are those of torch.

    Raises:
        ValueError: As for `resolve_backend`.
        XrgsError: As for `resolve_backend`, or the kernels of gsplat can't be loaded.
    """
    resolved = resolve_backend(backend)
    if resolved == "gsplat" and operation != "rasterizer":
        resolved = "torch"
    return _module(f"xrgs.splat.{resolved}.{operation}")


def device(backend: str) -> str:
    """Return the device of a backend's tensors, after checking that the backend can render.

    Raises:
        XrgsError: The backend is gsplat, and torch sees no GPU, or gsplat's kernels can't be built.
            The message says what is missing.
    """
    if backend == "gsplat":
        implementation("rasterizer", backend)
    return DEVICES[backend]


def check_raster(backend: str, raster: RasterSettings) -> None:
    """Refuse settings that differ from the constants of gsplat's kernels.

    Raises:
        XrgsError: The backend is gsplat, and a setting differs; the message names the setting.
    """
    if backend != "gsplat":
        return
    version, alpha_max = _gsplat_version()
    constants = {"alpha_min": 1 / 255, "alpha_max": alpha_max, "transmittance_min": 1e-4}
    for name, value in constants.items():
        if getattr(raster, name) != value:
            raise XrgsError(
                f"splat.raster.{name}={getattr(raster, name)}: the kernels of gsplat {version} have"
                f" {value}; set splat.raster.{name}={value}, or use another splat.backend"
            )


@functools.cache
def _gsplat_version() -> tuple[str, float]:
    """Return the installed version of gsplat, and the cap of alpha in its kernels."""
    try:
        version = metadata.version("gsplat").partition("+")[0]  # without a build tag as +pt24cu124
    except metadata.PackageNotFoundError:
        raise XrgsError(
            "splat.backend=gsplat: gsplat is not installed: pip install 'xrgs[gsplat]'"
        ) from None
    for known, alpha_max in _GSPLAT_ALPHA_MAX.items():
        if f"{version}.".startswith(f"{known}."):
            return version, alpha_max
    raise XrgsError(
        f"splat.backend=gsplat: gsplat {version} is installed, and xrgs knows"
        f" {' and '.join(_GSPLAT_ALPHA_MAX)}"
    )


def arithmetic(backend: str) -> str:
    """Name the arithmetic on which the last bits of a backend's results depend.

    The native kernels give the same bits on all instruction sets with a fused multiply-add, which
    rounds only once. Instruction sets without it round product and sum, and give other bits.

    Returns:
        - `fma` or `no-fma`: the instruction set that the native kernels use in this process.
        - `torch`: the last bits depend on the processor and the number of threads.
        - `gsplat <version>`: each version has its own constants, and the last bits differ from run
          to run.

    Raises:
        XrgsError: The backend is native and its module can't be loaded on this machine, or the
            backend is gsplat and not installed.
    """
    if backend == "torch":
        return "torch"
    if backend == "gsplat":
        return f"gsplat {_gsplat_version()[0]}"
    try:
        native = importlib.import_module(NATIVE_MODULE)
    except ImportError as error:
        raise XrgsError(
            f"splat.backend={backend}: {NATIVE_MODULE} can't be loaded ({error}); install xrgs"
            " again on this machine, or use splat.backend=torch"
        ) from error
    return "fma" if native.fused_multiply_add() else "no-fma"


#: Imports a module, and caches it, since each training step asks for several.
_module = functools.cache(importlib.import_module)


@functools.cache
def _warn_once() -> None:
    logging.getLogger(__name__).warning(
        "%s was not built: rendering with torch, which is many times slower", NATIVE_MODULE
    )
