"""What the system says of its processes, in /proc where it has that."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import cache
from pathlib import Path

_PROC = Path("/proc")
_STARTED, _SESSION = 19, 3  # fields of a process's `stat`, counted behind the name in brackets


def proc_exists() -> bool:
    """Tell whether this system has /proc."""
    return (_PROC / "self" / "stat").exists()


@cache
def boot() -> str:
    """Return an id of this boot and this process namespace; empty where the system has none."""
    try:
        boot_id = (_PROC / "sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot_id} {(_PROC / 'self/ns/pid').readlink()}"
    except OSError:
        return ""


def started(pid: int) -> int | None:
    """Return when a process started, which tells it from others that had its id before.

    A zombie (ended, and not waited for by its parent) is dead.

    Args:
        pid: The process's id.

    Returns:
        Clock ticks since the boot; 0 if the process exists and its start is unknown; None if it
        does not exist or is dead.
    """
    try:
        fields = _stat(_PROC / str(pid))
    except OSError:
        return None if proc_exists() else _start_unknown(pid)
    return None if fields[0] in "ZX" else int(fields[_STARTED])


def _start_unknown(pid: int) -> int | None:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        return 0
    return 0


def resident_bytes(session: int) -> int:
    """Return the resident bytes of all processes of a session; shared pages count for each.

    Args:
        session: The id of the session: that of the process that leads it.
    """
    page, total = os.sysconf("SC_PAGE_SIZE"), 0
    for folder in _PROC.iterdir():
        if folder.name.isdecimal():
            with suppress(OSError, IndexError):  # it may end while it is read
                if int(_stat(folder)[_SESSION]) == session:
                    total += page * int((folder / "statm").read_text(encoding="ascii").split()[1])
    return total


def _stat(process: Path) -> list[str]:
    """Return the fields of a process's `stat` behind its name, which may contain anything."""
    text = (process / "stat").read_text(encoding="utf-8", errors="replace")
    return text.rpartition(")")[2].split()


def offer_to_oom_killer() -> None:
    """Let the kernel kill this process before others when the machine runs out of memory."""
    with suppress(OSError):
        (_PROC / "self" / "oom_score_adj").write_text("500", encoding="ascii")
