"""The choice between the implementations of the model: compiled kernels, plain torch, or gsplat.

`native` and `torch` run on the CPU. `gsplat` runs on a GPU: `gsplat.rasterization` renders, and the
functions of `torch` do all else. This module imports torch only for a GPU, so that a plan can name
the backend of its cells.
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
"""Where each backend has its tensors."""
_GSPLAT_ALPHA_MAX = {"1.5.3": 0.999, "1.6": 0.99}
"""The versions of gsplat that are known, and the largest alpha in the kernels of each."""

Operation = Literal["activations", "densify", "loss", "optimizer", "rasterizer", "resample"]
"""The name of a module that both `xrgs/splat/torch/` and `xrgs/splat/native/` have.

`xrgs/splat/gsplat/` has the rasterizer only."""


def resolve_backend(name: str) -> str:
    """Return the backend that a configured name means on this machine.

    Args:
        name: `native`, `torch`, `gsplat`, or `auto`. `auto` means native if the extension was
            built. If not, `auto` means torch and logs one warning, or fails if the environment
            variable XRGS_REQUIRE_NATIVE is 1.

    Returns:
        `native`, `torch` or `gsplat`.

    Raises:
        ValueError: The name is none of the four.
        XrgsError: The native backend is configured or required, and was not built; or gsplat is
            configured, and is not installed or of a version that is not known.
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
    """Return the module that computes an operation, importing it when it is first needed.

    The modules of an operation have functions of the same names and parameters in all backends.

    Args:
        operation: The module's name.
        backend: `torch`, `native`, `gsplat` or `auto`, as for `resolve_backend`.

    Returns:
        `xrgs.splat.<backend>.<operation>`, of torch for all operations of gsplat but `rasterizer`.

    Raises:
        ValueError: As for `resolve_backend`.
        XrgsError: As for `resolve_backend`, or the kernels of gsplat can't be loaded.
    """
    resolved = resolve_backend(backend)
    if resolved == "gsplat" and operation != "rasterizer":
        resolved = "torch"
    return _module(f"xrgs.splat.{resolved}.{operation}")


def device(backend: str) -> str:
    """Return the device of the tensors of a backend, which is ready to render.

    Args:
        backend: `native`, `torch` or `gsplat`.

    Returns:
        `cpu`, or `cuda` for gsplat.

    Raises:
        XrgsError: The backend is gsplat, and torch sees no GPU, or gsplat's kernels are not built
            and can't be. The message says what is missing.
    """
    if backend == "gsplat":
        implementation("rasterizer", backend)
    return DEVICES[backend]


def check_raster(backend: str, raster: RasterSettings) -> None:
    """Refuse settings that gsplat has as constants of its kernels, of another value.

    Args:
        backend: `native`, `torch` or `gsplat`.
        raster: How Gaussians become pixels.

    Raises:
        XrgsError: The backend is gsplat, and a setting differs; the message names its key.
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
    """Return the version of gsplat that is installed, and the largest alpha in its kernels."""
    try:
        version = metadata.version("gsplat").partition("+")[0]  # +pt24cu124 names a build
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
    """Return the arithmetic that decides the last bits of a backend's results.

    All instruction sets with a fused multiply-add, which rounds a product and a sum once, give the
    same bits in the native kernels. Instruction sets without it round twice and give other bits.

    Args:
        backend: `native`, `torch` or `gsplat`.

    Returns:
        `fma` or `no-fma` for the instruction set that the native kernels use in this process, or
        `torch`: torch chooses an instruction set for each operation, and its last bits depend on
        the processor and the number of threads. Or `gsplat <version>`: versions of gsplat have
        other constants, and the last bits differ from run to run.

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


#: Imports a module, and remembers it: a training step asks for several.
_module = functools.cache(importlib.import_module)


@functools.cache
def _warn_once() -> None:
    logging.getLogger(__name__).warning(
        "%s was not built: rendering with torch, which is many times slower", NATIVE_MODULE
    )
