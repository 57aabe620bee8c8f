"""The choice between the two implementations of the model: compiled kernels or plain torch.

This module needs no torch, so that a plan can name the backend of its cells.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
import os
from types import ModuleType
from typing import Literal

from xrgs.errors import XrgsError

NATIVE_MODULE = "xrgs._native"
CHOICES = ("auto", "native", "torch")
REQUIRE_NATIVE = "XRGS_REQUIRE_NATIVE"

Operation = Literal["activations", "densify", "loss", "optimizer", "rasterizer", "resample"]
"""The name of a module that both `xrgs/splat/torch/` and `xrgs/splat/native/` have."""


def resolve_backend(name: str) -> str:
    """Return the backend that a configured name means on this machine.

    Args:
        name: `native`, `torch`, or `auto`. `auto` means native if the extension was built. If not,
            `auto` means torch and logs one warning, or fails if the environment variable
            XRGS_REQUIRE_NATIVE is 1.

    Returns:
        `native` or `torch`.

    Raises:
        ValueError: The name is none of the three.
        XrgsError: The native backend is configured or required, and was not built.
    """
    if name not in CHOICES:
        raise ValueError(f"backend must be one of {', '.join(CHOICES)}, got {name!r}")
    if name == "torch":
        return "torch"
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

    The modules of an operation have functions of the same names and parameters in both backends.

    Args:
        operation: The module's name.
        backend: `torch`, `native` or `auto`, as for `resolve_backend`.

    Returns:
        `xrgs.splat.torch.<operation>` or `xrgs.splat.native.<operation>`.

    Raises:
        ValueError: `backend` is none of the three.
        XrgsError: The native backend is configured or required, and was not built.
    """
    return _module(f"xrgs.splat.{resolve_backend(backend)}.{operation}")


def arithmetic(backend: str) -> str:
    """Return the arithmetic that decides the last bits of a backend's results.

    All instruction sets with a fused multiply-add, which rounds a product and a sum once, give the
    same bits in the native kernels. Instruction sets without it round twice and give other bits.

    Args:
        backend: `native` or `torch`.

    Returns:
        `fma` or `no-fma` for the instruction set that the native kernels use in this process, or
        `torch`: torch chooses an instruction set for each operation, and its last bits depend on
        the processor and the number of threads.

    Raises:
        XrgsError: The backend is native and its module can't be loaded on this machine.
    """
    if backend == "torch":
        return "torch"
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
