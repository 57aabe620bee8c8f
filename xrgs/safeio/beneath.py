"""Opens a path below a folder without following any link on the way."""

from __future__ import annotations

import ctypes
import errno
import os
import stat
import sys
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

#: Number of the system call openat2, the same on every architecture; Linux has it from 5.6 on.
_OPENAT2 = 437
#: Its flags: follow no link, and refuse a path that leads out of the folder.
_RESOLVE_NO_SYMLINKS, _RESOLVE_BENEATH = 0x04, 0x08
_STEP = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class _OpenHow(ctypes.Structure):
    """The kernel's `struct open_how`."""

    _fields_ = (
        ("flags", ctypes.c_uint64),
        ("mode", ctypes.c_uint64),
        ("resolve", ctypes.c_uint64),
    )


def open_folder_beneath(folder: int, parts: Sequence[str]) -> int:
    """Open a folder below another.

    Args:
        folder: Descriptor of the folder to start from.
        parts: The names on the way, at least one, none of them `..`.

    Returns:
        A descriptor for reading, which the caller closes.

    Raises:
        OSError: A name is missing, is not a folder, or is a link (ELOOP or ENOTDIR).
    """
    openat2 = _openat2()
    return by_hand(folder, parts) if openat2 is None else openat2(folder, parts)


def by_hand(folder: int, parts: Sequence[str]) -> int:
    """Do as `open_folder_beneath`, with one system call for each name."""
    descriptor = os.dup(folder)
    for name in parts:
        above = descriptor
        try:
            descriptor = os.open(name, _STEP, dir_fd=above)
        finally:
            os.close(above)
    return descriptor


@cache
def _openat2() -> Callable[[int, Sequence[str]], int] | None:
    """Return a function that opens with openat2; None where the system does not have it."""
    if sys.platform != "linux":
        return None
    syscall = ctypes.CDLL(None, use_errno=True).syscall
    syscall.restype = ctypes.c_long
    how = _OpenHow(_STEP, 0, _RESOLVE_NO_SYMLINKS | _RESOLVE_BENEATH)
    size = ctypes.c_size_t(ctypes.sizeof(how))

    def call(folder: int, parts: Sequence[str]) -> int:
        name = os.fsencode("/".join(parts))
        while True:
            descriptor = int(
                syscall(
                    ctypes.c_long(_OPENAT2), ctypes.c_int(folder), name, ctypes.byref(how), size
                )
            )
            if descriptor >= 0:
                return descriptor
            # The kernel asks to try again where something was renamed in between.
            if (number := ctypes.get_errno()) not in {errno.EAGAIN, errno.EINTR}:
                raise OSError(number, os.strerror(number))

    here = os.open("/", _STEP)
    try:
        os.close(call(here, ["."]))
    except OSError:  # an old kernel, or a sandbox that does not admit the call
        return None
    finally:
        os.close(here)
    return call


def regular_size(folder: int, name: str) -> int:
    """Return the bytes of a regular file of an open folder; -1 where there is none.

    Args:
        folder: Descriptor of the folder.
        name: A name in it.

    Raises:
        OSError: It can't be told now what there is.
    """
    try:
        status = os.stat(name, dir_fd=folder, follow_symlinks=False)
    except (FileNotFoundError, NotADirectoryError):
        return -1
    return status.st_size if stat.S_ISREG(status.st_mode) else -1
