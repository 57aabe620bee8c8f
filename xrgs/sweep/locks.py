"""Locks that are plain files: each cell has one owner, for sweeps on several machines.

A lock is the file `<name>.<generation>`, created with O_CREAT | O_EXCL. That is atomic on local
disks, NFS from version 3 on, SMB and the cluster file systems; flock is not used, because not all
of them pass it on from one machine to another. A process that finds the lock of a dead owner
creates the next generation: of any number of contenders one succeeds, and none deletes a file that
another has just created. The owner touches its file regularly as a sign of life (its heartbeat).

An owner in the same place (host name, boot and process namespace) is alive as long as its process
exists, suspended or not. An owner elsewhere is alive as long as its last heartbeat is younger than
`SILENT_S`. Both times are the file server's, so that clocks that differ do no harm.
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
from xrgs.safeio.confined import ConfinedPath, confined

#: Seconds between two heartbeats, and seconds without one after which an owner on another machine
#: is taken for dead.
BEAT_S = 30.0
SILENT_S = 600.0
#: Seconds that a lock file may be without its owner's signature. Its creator writes the signature
#: at once and looks for other owners only then: if it was killed or suspended in between, it does
#: not hold the lock yet.
_UNSIGNED_S = 30.0
_MAX_BYTES = 4096  # of a lock's file


@dataclass(frozen=True)
class Owner:
    """The process that holds a lock, as its signature in the file names it."""

    host: str
    """Name of its machine."""
    boot: str
    """Id of the machine's boot and of the process namespace; process ids are valid within both."""
    pid: int
    """Its process id."""
    started: int
    """When the process started, clock ticks since boot, since process ids are reused; 0 if unknown.
    """
    worker: int = 0
    """Id of the child process that works under the lock, 0 if there is none. It may outlive the
    owner for a moment, and would then write to the files of the next owner."""
    worker_started: int = 0
    """When the child process started, as for `started`."""

    @property
    def lives(self) -> bool:
        """Whether one of its processes exists, suspended or not; only valid if it is `here`."""
        if _start(self.pid) == self.started:
            return True
        return bool(self.worker) and _start(self.worker) == self.worker_started

    @property
    def here(self) -> bool:
        """Whether its processes would run on this machine, boot and process namespace."""
        return (self.host, self.boot) == (socket.gethostname(), _boot())

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"


@dataclass
class Lock:
    """A lock that this process holds until `release`."""

    path: ConfinedPath
    """The lock's file."""
    beaten: float
    """When the last heartbeat was given, seconds of the monotonic clock."""
    owner: Owner
    """The signature of this process in the file."""

    def beat(self, worker: int = 0) -> bool:
        """Give a heartbeat if one is due.

        Args:
            worker: Id of the child process that works under the lock, 0 if there is none. From now
                on the child is an owner as well.

        Returns:
            False if the lock is lost: this process was suspended or cut off from the store for so
            long that another one has taken over.
        """
        known = worker == self.owner.worker
        if known and time.monotonic() - self.beaten < BEAT_S:
            return True
        self.beaten = time.monotonic()
        name, generation = _parts(self.path)
        if signature(self.path) not in {None, self.owner}:
            return False
        try:
            self.path.touch()
            if not known:
                owner = replace(self.owner, worker=worker, worker_started=_start(worker) or 0)
                write_json(self.path, asdict(owner))
                self.owner = owner
            last = max(_generations(self.path.parent, name), default=generation)
        except FileNotFoundError:
            return False
        except OSError:  # the store is out of reach for now; a later heartbeat decides
            return True
        return last == generation

    def release(self) -> None:
        """Release the lock, unless it was lost to another owner."""
        with suppress(OSError):  # a file that is left behind is dead when this process has ended
            if signature(self.path) == self.owner:
                self.path.unlink()


def acquire(folder: ConfinedPath, name: str) -> Lock | None:
    """Take a lock, unless a living owner holds it.

    Args:
        folder: The folder of the locks.
        name: The lock's name.

    Returns:
        The lock; None if a living owner holds it.

    Raises:
        OSError: The folder can't be written.
    """
    while True:
        files = _generations(folder, name)
        if any(_living(file) for file in files.values()):
            return None
        file = folder / f"{name}.{max(files, default=-1) + 1}"
        try:
            owner = sign(file)
        except FileExistsError:
            continue  # another contender was faster: list the files again
        # The list above may be outdated. A contender that came since is found by listing once more:
        # of two, at least one sees the other. If both give way, nothing is lost but a try.
        others = [other for other in _generations(folder, name).values() if other != file]
        checked = [(other, _living(other)) for other in others]
        if any(living for _, living in checked):
            file.unlink(missing_ok=True)
            return None
        for other, living in checked:
            if living is False:  # None is a released lock, which may exist again, with a new owner
                other.unlink(missing_ok=True)
        return Lock(file, time.monotonic(), owner)


def names(folder: ConfinedPath) -> set[str]:
    """Return the names of all locks in a folder, whether their owners are alive or not.

    Args:
        folder: The folder of the locks.
    """
    return {file.stem for file in folder.iterdir() if file.suffix[1:].isdecimal()}


def holders(folder: ConfinedPath) -> dict[str, str]:
    """Return a description of the living owner of each lock in a folder.

    Args:
        folder: The folder of the locks, which need not exist.

    Returns:
        Descriptions for people, by the name of the lock.
    """
    try:
        files = folder.iterdir()
    except OSError:
        return {}
    return {
        _parts(file)[0]: str(signature(file) or "a process that has not signed its lock yet")
        for file in files
        if file.suffix[1:].isdecimal() and _living(file)
    }


def sign(path: Path | ConfinedPath) -> Owner:
    """Create a file that names this process as its owner.

    Args:
        path: The file.

    Returns:
        The signature that was written.

    Raises:
        FileExistsError: The file exists.
    """
    owner, file = _self(), confined(path)
    with file.create() as stream:
        try:
            stream.write(json.dumps(asdict(owner)).encode())
            stream.flush()
        except BaseException:
            file.unlink(missing_ok=True)
            raise
    return owner


def signature(path: Path | ConfinedPath) -> Owner | None:
    """Return the owner that a file names; None if it does not name one.

    Args:
        path: A file that `sign` has created.
    """
    try:
        owner = Owner(**untrusted.parse_json(confined(path).read_bytes(_MAX_BYTES)))
    except (OSError, ValueError, TypeError):
        return None
    texts = {"host", "boot"}
    valid = all(type(v) is (str if k in texts else int) for k, v in vars(owner).items())
    return owner if valid else None


def _parts(file: ConfinedPath) -> tuple[str, int]:
    """Return the name and the generation of a lock's file."""
    return file.stem, int(file.suffix[1:])


def _generations(folder: ConfinedPath, name: str) -> dict[int, ConfinedPath]:
    files = (file for file in folder.iterdir() if file.stem == name)
    return {_parts(file)[1]: file for file in files if file.suffix[1:].isdecimal()}


def _living(file: ConfinedPath) -> bool | None:
    """Return whether a lock's owner is alive; None if the lock was released meanwhile."""
    owner = signature(file)
    if owner is not None and owner.here:
        return owner.lives or (False if signature(file) == owner else None)
    silent = _UNSIGNED_S if owner is None else SILENT_S
    try:
        return _now(file.parent) - file.lstat().st_mtime < silent
    except OSError:
        return None


def _now(folder: ConfinedPath) -> float:
    """Return the file server's time; this machine's if the folder can't be written."""
    probe = folder / f".now-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        probe.create().close()
        now = probe.lstat().st_mtime
        probe.unlink()
    except OSError:
        return time.time()
    return now


def _self() -> Owner:
    """Return this process as an owner. It is not cached: the process may be forked."""
    return Owner(socket.gethostname(), _boot(), os.getpid(), _start(os.getpid()) or 0)


@cache
def _boot() -> str:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def _start(pid: int) -> int | None:
    """Return when a process started, clock ticks since boot; 0 if unknown, None if it is dead.

    A zombie (ended, and not waited for by its parent) is dead.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None if Path("/proc/self/stat").exists() else _start_unknown(pid)
    fields = text.rpartition(")")[2].split()  # the name in brackets may contain anything
    return None if fields[0] in "ZX" else int(fields[19])


def _start_unknown(pid: int) -> int | None:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        return 0
    return 0
