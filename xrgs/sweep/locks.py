"""One owner for each cell: locks that are files alone, for sweeps on several machines.

A lock is the file `<name>.<generation>`, made with O_CREAT | O_EXCL, which local disks, NFS from
version 3 on, SMB and the cluster file systems do atomically. Nothing rests on flock, which not all
of them carry from one machine to another. Who finds a dead owner's lock makes the next generation:
one of any number succeeds, and nobody deletes what another may just have made. The owner touches
its file as a sign of life.

An owner in the same place (host name, boot and process namespace) is alive as long as its process
runs, stopped or not. One elsewhere is alive as long as its sign is younger than `SILENT_S`; both
times are the file server's, so that clocks that differ do no harm.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json

#: Seconds from one sign of life to the next, and after how many without one an owner elsewhere is
#: taken for dead.
BEAT_S = 30.0
SILENT_S = 600.0
#: Seconds that a lock may be without an owner's name. Who makes one writes it at once, and looks
#: for others after that: one that was killed or suspended in between holds nothing yet.
_NAMELESS_S = 30.0


@dataclass(frozen=True)
class Owner:
    """Who holds a lock."""

    host: str
    boot: str
    """Of the machine and of the process namespace: process numbers mean something within both."""
    pid: int
    started: int
    """Of the process, clock ticks since boot: numbers are given again. 0 where it is not known."""
    worker: int = 0
    """The process that works under the lock, 0 where there is none: it may outlive for a moment
    the one that holds it, and write to what the next one has begun."""
    worker_started: int = 0

    @property
    def lives(self) -> bool:
        """Whether one of its processes runs, stopped or not; to be asked where they would run."""
        if _start(self.pid) == self.started:
            return True
        return bool(self.worker) and _start(self.worker) == self.worker_started

    @property
    def here(self) -> bool:
        """Whether its processes would run in this place."""
        return (self.host, self.boot) == (socket.gethostname(), _boot())

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"


@dataclass
class Lock:
    """A lock that this process holds until `release`."""

    path: Path
    beaten: float
    owner: Owner

    def beat(self, worker: int = 0) -> bool:
        """Give a sign of life if one is due.

        Args:
            worker: the process that works under the lock, if any; from now on it holds it as well.

        Returns:
            False where the lock is lost: this process gave none for so long, suspended or cut off
            from the store, that another has taken over.
        """
        known = worker == self.owner.worker
        if known and time.monotonic() - self.beaten < BEAT_S:
            return True
        self.beaten = time.monotonic()
        name, generation = _parts(self.path)
        if signature(self.path) not in {None, self.owner}:
            return False
        try:
            os.utime(self.path)
            if not known:
                owner = replace(self.owner, worker=worker, worker_started=_start(worker) or 0)
                write_json(self.path, asdict(owner))
                self.owner = owner
            last = max(_generations(self.path.parent, name), default=generation)
        except FileNotFoundError:
            return False
        except OSError:  # the store is out of reach for now: whether for too long, it will tell
            return True
        return last == generation

    def release(self) -> None:
        """Let the next one have it."""
        with suppress(OSError):  # left behind, it dies with this process
            if signature(self.path) == self.owner:  # not the next one's, where this one was lost
                self.path.unlink()


def acquire(folder: Path, name: str) -> Lock | None:
    """The lock `name` in a folder, or None where a living owner has it.

    Raises:
        OSError: the folder can't be written.
    """
    while True:
        found = _generations(folder, name)
        if any(_living(file) for file in found.values()):
            return None
        file = folder / f"{name}.{max(found, default=-1) + 1}"
        try:
            owner = sign(file)
        except FileExistsError:
            continue  # another was quicker: look again
        # What was listed above may be long past: whoever came meanwhile is seen here, and of two
        # at least one sees the other. Both giving way costs nothing but another try.
        others = [other for other in _generations(folder, name).values() if other != file]
        seen = [(other, _living(other)) for other in others]
        if any(living for _, living in seen):
            file.unlink(missing_ok=True)
            return None
        for other, living in seen:
            if living is False:  # one that is gone may have been made anew, by the living
                other.unlink(missing_ok=True)
        return Lock(file, time.monotonic(), owner)


def names(folder: Path) -> set[str]:
    """Of the locks in a folder, of the living and the dead."""
    return {file.stem for file in folder.iterdir() if file.suffix[1:].isdecimal()}


def holders(folder: Path) -> dict[str, Owner | None]:
    """The living owner of every lock in a folder; None where it has not said yet who it is."""
    try:
        files = [Path(entry.path) for entry in os.scandir(folder)]
    except OSError:
        return {}
    return {
        _parts(file)[0]: signature(file)
        for file in files
        if file.suffix[1:].isdecimal() and _living(file)
    }


def sign(file: Path) -> Owner:
    """Make the file and say in it whose it is: this process's.

    Raises:
        FileExistsError: it is there.
    """
    owner = _self()
    with file.open("x", encoding="utf-8") as stream:
        try:
            stream.write(json.dumps(asdict(owner)))
            stream.flush()
        except BaseException:
            file.unlink(missing_ok=True)
            raise
    return owner


def signature(file: Path) -> Owner | None:
    """Whose file it is; None where it does not say."""
    try:
        owner = Owner(**untrusted.parse_json(untrusted.read_bytes(file)))
    except (OSError, ValueError, TypeError):
        return None
    texts = {"host", "boot"}
    right = all(type(v) is (str if k in texts else int) for k, v in vars(owner).items())
    return owner if right else None


def _parts(file: Path) -> tuple[str, int]:
    return file.stem, int(file.suffix[1:])


def _generations(folder: Path, name: str) -> dict[int, Path]:
    found = (file for file in folder.iterdir() if file.stem == name)
    return {_parts(file)[1]: file for file in found if file.suffix[1:].isdecimal()}


def _living(file: Path) -> bool | None:
    """Whether a lock's owner is; None where it has released it since, as the living do."""
    owner = signature(file)
    if owner is not None and owner.here:
        return owner.lives or (False if signature(file) == owner else None)
    silent = _NAMELESS_S if owner is None else SILENT_S
    try:
        return _now(file.parent) - file.stat().st_mtime < silent
    except OSError:
        return None


def _now(folder: Path) -> float:
    """The file server's time; this machine's where nothing can be written."""
    probe = folder / f".now-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        probe.touch()
        now = probe.stat().st_mtime
        probe.unlink()
    except OSError:
        return time.time()
    return now


def _self() -> Owner:
    """This process, which may be a fork of the one that asked before."""
    return Owner(socket.gethostname(), _boot(), os.getpid(), _start(os.getpid()) or 0)


@cache
def _boot() -> str:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def _start(pid: int) -> int | None:
    """When a process began, clock ticks since boot; 0 where the system doesn't tell, None if dead.

    One that has ended and whose parent has not asked for it yet is dead.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None if Path("/proc/self/stat").exists() else _start_unknown(pid)
    fields = text.rpartition(")")[2].split()  # the name in brackets may hold anything
    return None if fields[0] in "ZX" else int(fields[19])


def _start_unknown(pid: int) -> int | None:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        return 0
    return 0
