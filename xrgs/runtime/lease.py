"""Leases: plain files that give each cell, variant and rendered scene one owner at a time.

A lease is the file `<name>.<generation>`, created with O_CREAT | O_EXCL. That is atomic on local
disks, NFS from version 3 on, SMB and cluster file systems. flock is not used, because not all of
them pass it on from one machine to another. A process that finds the lease of a dead owner creates
the next generation: of any number of contenders one succeeds, and none deletes a file that another
one has just created.

The file holds its owner's signature and a counter of heartbeats. A thread of the owner raises the
counter every `BEAT_S` seconds. It writes into the file that it has created, and never creates or
replaces one: where another process has taken over meanwhile, nothing is disturbed.

An owner is alive or dead by these rules:

- An owner in the same place (host name, boot and process namespace) is alive as long as its process
  exists, suspended or not.
- An owner elsewhere is alive while its file is young: changed less than `SILENT_S` seconds ago.
  Both times are the file server's, so that machines whose clocks differ do no harm.
- The file of an owner elsewhere that is older, or dated in the future, does not say enough, because
  the file server's clock may have been set. The observer watches it: the owner is dead when content
  and time have stood still for `CONFIRM_S` seconds of the observer's own clock, which nobody sets.
  Until then the owner counts as alive.
- A file without a signature is free when it is older than `_UNSIGNED_S` seconds. Its creator signs
  it at once, and looks for other owners only then: a creator that was killed or suspended in
  between does not hold the lease yet. Such a file that is dated in the future is watched like the
  others.
- The owner of a file that can't be read now counts as alive.

Watching does not wait: `acquire` and `holders` look at a file, and compare it with the last look of
this process. Between two looks at most `BEAT_S` seconds are counted, so that an owner
is not dead before its next heartbeat when a file server has answered nobody for a while.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from time import monotonic
from typing import TYPE_CHECKING

import msgspec

from xrgs.runtime import processes
from xrgs.runtime.text import format_duration
from xrgs.safeio.files import is_transient, read_bytes
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_log = logging.getLogger(__name__)

#: Seconds between two heartbeats, and seconds without one after which an owner on another machine
#: may be dead.
BEAT_S = 30.0
SILENT_S = 600.0
#: Seconds that a watched file has to stand still: two heartbeats, and a margin.
CONFIRM_S = 65.0
#: The most seconds into the future of a file's date that are an inexact clock or a cache.
_AHEAD_S = 5.0
#: Seconds that a lease may be without its owner's signature.
_UNSIGNED_S = 30.0
#: Seconds between two tries of `waited_for`.
_POLL_S = 0.5
#: Bytes of a lease's file, filled with spaces so that each heartbeat replaces all of it at once,
#: and the most that is read.
_BYTES, _MAX_BYTES = 1024, 4096


class _State(Enum):
    """The state of the owner of a lease's file."""

    ALIVE = 1
    WATCHED = 2
    """Counts as alive until it was watched for long enough."""
    DEAD = 3
    RELEASED = 4
    """The file is gone, or is another owner's now."""


class Owner(msgspec.Struct, frozen=True):
    """The process that holds a lease, as its signature in the file names it."""

    host: str
    boot: str
    """Id of the machine's boot and process namespace; process ids are valid within both."""
    pid: int
    started: float
    """Seconds from the boot to the start of the process: process ids are given again."""

    @property
    def lives(self) -> bool:
        """Whether the process exists, suspended or not; only valid if it is `here`."""
        return processes.lives(self.pid, self.started)

    @property
    def here(self) -> bool:
        """Whether the process would run on this machine, boot and process namespace."""
        return (self.host, self.boot) == (socket.gethostname(), processes.boot())

    def __str__(self) -> str:
        return f"process {self.pid} on {for_line(self.host)}"


class Lease:
    """A lease that this process holds until `release`; a thread gives its heartbeats."""

    def __init__(self, path: Path, owner: Owner) -> None:
        """Start the heartbeats of a lease's file that `sign` has just created."""
        self.path, self.owner = path, owner
        self.beats = 0
        self.lost = False
        """Whether another process has taken over: this process was suspended, or cut off from the
        file server, for too long. The cell's files are the other one's then."""
        self._ended = threading.Event()
        threading.Thread(target=self._keep_beating, name="xrgs-lease", daemon=True).start()

    def _keep_beating(self) -> None:
        while not self.lost and not self._ended.wait(BEAT_S):
            self.beat()

    def beat(self) -> bool:
        """Give a heartbeat; return False if the lease is lost."""
        # Where the file server is out of reach now, a later heartbeat decides.
        with suppress(OSError):
            try:
                self.lost = self.lost or not (self._write() and self._is_last())
            except FileNotFoundError:
                self.lost = True
        return not self.lost

    def _write(self) -> bool:
        """Write the signature with the next count; return False if the file is another owner's."""
        with self.path.open("r+b") as stream:
            if _parse(stream.read(_MAX_BYTES)) not in {None, self.owner}:
                return False
            self.beats += 1
            stream.seek(0)
            stream.write(_text(self.owner, self.beats))
        return True

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
    """Take a lease; return None if its owner is alive or is still watched.

    Raises:
        OSError: The folder of the leases can't be read or written.
    """
    taken = {_State.ALIVE, _State.WATCHED}
    while True:
        files = _generations(folder, name)
        if any(_look(file)[0] in taken for file in files.values()):
            return None
        file = folder / f"{name}.{max(files, default=-1) + 1}"
        try:
            owner = sign(file)
        except FileExistsError:
            continue  # another contender was faster: list the files again
        # The list above may be outdated. A contender that came since is found by listing once more:
        # of two, at least one sees the other. If both give way, nothing is lost but a try.
        others = [other for other in _generations(folder, name).values() if other != file]
        states = [(other, _look(other)[0]) for other in others]
        if any(state in taken for _, state in states):
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
def waited_for(folder: Path, name: str) -> Iterator[Lease]:
    """Hold a lease during a block, after waiting until its owner has released it or is dead.

    Raises:
        OSError: The folder of the leases can't be read or written.
    """
    said = False
    while (lease := acquire(folder, name)) is None:
        if not said:
            _log.warning("%s: waiting until another process has finished", folder / name)
            said = True
        time.sleep(_POLL_S)
    try:
        yield lease
    finally:
        lease.release()


def free_if_dead(folder: Path, name: str) -> None:
    """Remove the files of dead owners of a lease, if this process has watched them long enough."""
    if any(_parts(file)[0] == name for file in _files(folder)):
        lease = acquire(folder, name)
        if lease is not None:
            lease.release()


def names(folder: Path) -> set[str]:
    """Return the names of all leases in a folder, whether their owners are alive or not."""
    return {_parts(file)[0] for file in _files(folder)}


def holders(folder: Path) -> dict[str, str]:
    """Describe the owner of each lease in a folder, without owners that are known to be dead.

    Owners that may be dead are watched from then on. The folder need not exist.

    Returns:
        Descriptions for people, by the name of the lease.
    """
    found = {}
    for file in _files(folder):
        state, age = _look(file)
        if state in {_State.ALIVE, _State.WATCHED}:
            owner = str(signature(file) or "a process that has not signed its lease yet")
            found[_parts(file)[0]] = owner + (_silent(age) if state is _State.WATCHED else "")
    return found


def _silent(age: float) -> str:
    if age < 0:
        return f"; its lease is dated {format_duration(-age)} in the future; it may be dead"
    return f", silent for {format_duration(age)}; it may be dead"


def sign(path: Path) -> Owner:
    """Create a file that names this process as its owner, and return the signature.

    Raises:
        FileExistsError: The file exists.
    """
    owner = _self()
    with path.open("xb") as stream:
        try:
            stream.write(_text(owner, 0))
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


def _text(owner: Owner, beats: int) -> bytes:
    values = msgspec.structs.asdict(owner) | {"beats": beats}
    return json.dumps(values).encode().ljust(_BYTES - 1) + b"\n"


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


def _look(file: Path) -> tuple[_State, float]:
    """Return the state of a lease's owner, and the seconds since the file changed, 0 if here."""
    try:
        content, status = read_bytes(file, _MAX_BYTES), file.stat()
    except FileNotFoundError:
        return _State.RELEASED, 0.0
    except OSError as error:
        # A folder or a pipe is not a lease of any process.
        return (_State.ALIVE if is_transient(error) else _State.DEAD), 0.0
    owner = _parse(content)
    if owner is None or not owner.here:
        age = _now(file.parent) - status.st_mtime
        return _judged(owner, age, status, content), age
    if owner.lives:
        return _State.ALIVE, 0.0
    return (_State.DEAD if signature(file) == owner else _State.RELEASED), 0.0


def _judged(owner: Owner | None, age: float, status: os.stat_result, content: bytes) -> _State:
    """Judge a lease whose owner is on another host, boot or process namespace."""
    if -_AHEAD_S <= age < (_UNSIGNED_S if owner is None else SILENT_S):
        return _State.ALIVE
    if (owner is None and age > 0) or _stands_still(status, content):
        return _State.DEAD
    return _State.WATCHED


@dataclass
class _Watch:
    """The looks of this process at a file that does not tell whether its owner is alive."""

    seen: tuple[int, bytes]
    """The file's time, in nanoseconds, and its content."""
    looked: float
    """Time of the last look, seconds of the monotonic clock."""
    still: float = 0.0
    """Seconds that the file has stood still."""


#: By device and inode: a store has several paths.
_watches: dict[tuple[int, int], _Watch] = {}


def _stands_still(status: os.stat_result, content: bytes) -> bool:
    """Watch a file; return whether it has not changed for `CONFIRM_S` seconds."""
    key, now = (status.st_dev, status.st_ino), monotonic()
    seen = (status.st_mtime_ns, content)
    watch = _watches.get(key)
    if watch is None or watch.seen != seen:
        watch = _watches[key] = _Watch(seen, now)
    watch.still += min(now - watch.looked, BEAT_S)
    watch.looked = now
    return watch.still >= CONFIRM_S


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


def _self() -> Owner:
    """Return this process as an owner. It is not cached, because a process may be forked."""
    pid = os.getpid()
    return Owner(socket.gethostname(), processes.boot(), pid, processes.started(pid))
