"""Leases: plain files that give each cell, variant and rendered scene one owner at a time.

A lease is the file `<name>.<generation>`, created with O_CREAT | O_EXCL. That is atomic on local
disks, NFS from version 3 on, SMB and cluster file systems. flock is not used, because not all of
them pass it on from one machine to another. A process that finds the lease of a dead owner creates
the next generation: of any number of contenders one succeeds, and none deletes a file that another
one has just created.

The file holds its owner's signature. A thread of the owner renews the file's date every `BEAT_S`
seconds. It never creates or replaces a file: where another process has taken over meanwhile,
nothing is disturbed.

An owner in the same place (host name, boot and process namespace) is alive as long as its process
exists, suspended or not. An owner elsewhere is alive while the file's date is less than `SILENT_S`
seconds from now, and one that has not signed its file yet while it is less than `UNSIGNED_S`. Both
times are the file server's, so that machines whose clocks differ do no harm. An owner that is cut
off from the file server for so long loses its lease; it notices before it writes a result
(`Lease.lost`).
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path

import msgspec

from xrgs.runtime import machine
from xrgs.safeio.files import read_bytes
from xrgs.safeio.sanitize import for_line

_log = logging.getLogger(__name__)

#: Seconds between two heartbeats.
BEAT_S = 30.0
#: An owner on another machine is dead after this many seconds without a heartbeat.
SILENT_S = 600.0
#: A file that is empty for this many seconds is of an owner that was killed before it signed, which
#: takes milliseconds. An owner that was only suspended finds out that it has lost its lease.
UNSIGNED_S = 60.0
#: Seconds between two tries of `waited_for`.
_POLL_S = 0.5
#: The most bytes of a lease's file that are read.
_MAX_BYTES = 4096


class _State(Enum):
    """The state of the owner of a lease's file."""

    ALIVE = 1
    DEAD = 2
    RELEASED = 3
    """The file is gone, or is another owner's now."""


class Owner(msgspec.Struct, frozen=True):
    """The process that holds a lease, as its signature in the file names it."""

    host: str
    boot: str
    """Id of the machine's boot and process namespace. A process id is unique only within both."""
    pid: int
    started: float
    """Seconds from the boot to the start of the process: a later process may have the same id."""

    @property
    def lives(self) -> bool:
        """Whether the process exists, suspended or not; only valid if it is `here`."""
        return machine.lives(self.pid, self.started)

    @property
    def here(self) -> bool:
        """Whether the process belongs to this machine, its present boot and process namespace."""
        return (self.host, self.boot) == (socket.gethostname(), machine.boot())

    def __str__(self) -> str:
        return f"process {self.pid} on {for_line(self.host)}"


class Lease:
    """A lease that this process holds until `release`; a thread gives its heartbeats."""

    def __init__(self, path: Path, owner: Owner) -> None:
        """Start the heartbeats of a lease's file that `sign` has just created."""
        self.path, self.owner = path, owner
        self.lost = False
        """Whether another process has taken over, because this one was suspended, or cut off from
        the file server, for too long. The cell's files then belong to the other process."""
        self._ended = threading.Event()
        threading.Thread(target=self._keep_beating, name="xrgs-lease", daemon=True).start()

    def _keep_beating(self) -> None:
        while not self.lost and not self._ended.wait(BEAT_S):
            self.beat()

    def beat(self) -> bool:
        """Give a heartbeat; return False if the lease is lost."""
        # While the file server is out of reach, nothing is decided: a later heartbeat tells.
        with suppress(OSError):
            try:
                mine = _parse(read_bytes(self.path, _MAX_BYTES)) == self.owner
                self.lost = self.lost or not (mine and self._is_last())
                if not self.lost:
                    os.utime(self.path)
            except FileNotFoundError:
                self.lost = True
        return not self.lost

    def _is_last(self) -> bool:
        name, generation = _parts(self.path)
        return max(_generations(self.path.parent, name), default=generation) == generation

    def release(self) -> None:
        """Release the lease, unless it was lost to another owner."""
        self._ended.set()
        with suppress(OSError):  # a file that is left behind is dead when this process has ended
            if signature(self.path) == self.owner:
                self.path.unlink()


def acquire(folder: Path, name: str) -> Lease | None:
    """Take a lease; return None if its owner is alive."""
    while True:
        files = _generations(folder, name)
        if any(_state(file) is _State.ALIVE for file in files.values()):
            return None
        file = folder / f"{name}.{max(files, default=-1) + 1}"
        try:
            owner = sign(file)
        except FileExistsError:
            continue  # another contender was faster: list the files again
        # The list above may be outdated. A contender that came since is found by listing once more:
        # of two, at least one sees the other. If both give way, nothing is lost but a try.
        others = [other for other in _generations(folder, name).values() if other != file]
        states = [(other, _state(other)) for other in others]
        if any(state is _State.ALIVE for _, state in states):
            file.unlink(missing_ok=True)
            return None
        for other, state in states:
            # A released lease may exist again, with a new owner. One that can't be removed is dead
            # for the next process as well.
            if state is _State.DEAD:
                with suppress(OSError):
                    other.unlink()
        return Lease(file, owner)


@contextmanager
def held(folder: Path, name: str) -> Iterator[Lease | None]:
    """Hold a lease during a block; None where its owner is alive."""
    lease = acquire(folder, name)
    try:
        yield lease
    finally:
        if lease is not None:
            lease.release()


@contextmanager
def waited_for(folder: Path, name: str) -> Iterator[Lease]:
    """Hold a lease during a block, after waiting until its owner has released it or is dead."""
    warned = False
    while (lease := acquire(folder, name)) is None:
        if not warned:
            _log.warning("%s: waiting until another process has finished", folder / name)
            warned = True
        time.sleep(_POLL_S)
    try:
        yield lease
    finally:
        lease.release()


def names(folder: Path) -> set[str]:
    """Return the names of all leases in a folder, whether their owners are alive or not."""
    return {_parts(file)[0] for file in _files(folder)}


def holders(folder: Path) -> dict[str, str]:
    """Describe for people the owner of each lease in a folder, without dead owners, by its name.

    The folder need not exist.
    """
    return {
        _parts(file)[0]: str(signature(file) or "a process that has not signed its lease yet")
        for file in _files(folder)
        if _state(file) is _State.ALIVE
    }


def sign(path: Path) -> Owner:
    """Create a file that names this process as its owner, and return the signature.

    FileExistsError if it exists.
    """
    pid = os.getpid()  # not cached: a process may be forked
    owner = Owner(socket.gethostname(), machine.boot(), pid, machine.started(pid))
    with path.open("xb") as stream:
        try:
            stream.write(json.dumps(msgspec.structs.asdict(owner)).encode())
            stream.flush()
        except BaseException:
            path.unlink(missing_ok=True)
            raise
    return owner


def signature(path: Path) -> Owner | None:
    """Return the owner that a file names; None if it names none or can't be read now."""
    try:
        return _parse(read_bytes(path, _MAX_BYTES))
    except OSError:
        return None


def _parse(content: bytes) -> Owner | None:
    with suppress(msgspec.DecodeError, UnicodeDecodeError):
        return msgspec.json.decode(content, type=Owner)
    return None


def _parts(file: Path) -> tuple[str, int]:
    """Return the name and the generation of a lease's file."""
    return file.stem, int(file.suffix[1:])


def _files(folder: Path) -> list[Path]:
    """Return the files of all leases; none where the folder can't be read."""
    try:
        return [file for file in folder.iterdir() if file.suffix[1:].isdecimal()]
    except OSError:
        return []


def _generations(folder: Path, name: str) -> dict[int, Path]:
    files = (file for file in folder.iterdir() if file.stem == name)
    return {_parts(file)[1]: file for file in files if file.suffix[1:].isdecimal()}


def _state(file: Path) -> _State:
    """Return the state of a lease's owner; one whose file can't be read counts as alive."""
    try:
        content, changed = read_bytes(file, _MAX_BYTES), file.stat().st_mtime
    except FileNotFoundError:
        return _State.RELEASED
    except OSError:
        return _State.ALIVE
    owner = _parse(content)
    if owner is None or not owner.here:
        # A live owner mends a date far in the future with its next heartbeat.
        alive = abs(_now(file.parent) - changed) < (SILENT_S if content else UNSIGNED_S)
        return _State.ALIVE if alive else _State.DEAD
    if owner.lives:
        return _State.ALIVE
    return _State.DEAD if signature(file) == owner else _State.RELEASED


def _now(folder: Path) -> float:
    """Return the file server's time; this machine's if the folder can't be written."""
    probe = folder / f".now-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        probe.open("xb").close()
        now = probe.stat().st_mtime
        probe.unlink()
    except OSError:
        return time.time()
    return now
