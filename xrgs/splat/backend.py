"""Which renderer runs: the compiled one where it was built, else the torch one.

Needs no torch, so that a plan can name the backend of its cells.
"""

from __future__ import annotations

import functools
import importlib.util
import logging
import os

from xrgs.errors import XrgsError

NATIVE_MODULE = "xrgs._native"
CHOICES = ("auto", "native", "torch")
REQUIRE_NATIVE = "XRGS_REQUIRE_NATIVE"


def resolve_backend(name: str) -> str:
    """The renderer that `name` means on this machine.

    Args:
        name: `native`, `torch`, or `auto`: native where the extension was built. Where it was not,
            `auto` says so once in the log, or fails if XRGS_REQUIRE_NATIVE is 1.

    Returns:
        `native` or `torch`.

    Raises:
        ValueError: name is none of the three.
        XrgsError: the native backend was asked for, or required, and is not there.
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


@functools.cache
def _warn_once() -> None:
    logging.getLogger(__name__).warning(
        "%s was not built: rendering with torch, which is many times slower", NATIVE_MODULE
    )
