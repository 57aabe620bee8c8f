"""Locks that are plain files: each cell has one owner, for sweeps on several machines.

A lock is the file `<name>.<generation>`, created with O_CREAT | O_EXCL. That is atomic on local
disks, NFS from version 3 on, SMB and the cluster file systems; flock is not used, because not all
of them pass it on from one machine to another. A process that finds the lock of a dead owner
creates the next generation: of any number of contenders one succeeds, and none deletes a file that
another has just created.

The file holds its owner's signature and a counter of its heartbeats. Every `BEAT_S` seconds the
owner raises the counter. It writes into the file that it opened and found to be its own, and never
creates or replaces one: where another process has taken over meanwhile, nothing is disturbed.

Who is alive is decided like this:

- An owner in the same place (host name, boot and process namespace) is alive as long as its process
  exists, suspended or not.
- An owner elsewhere is alive while its file is young: changed less than `SILENT_S` seconds ago.
  Both times are the file server's, so that machines whose clocks differ do no harm.
- A file of an owner elsewhere that is older, or is dated in the future, does not say enough: the
  file server's clock may have been set. It is watched. The observer remembers the content and the
  time of the file, and the owner is dead when both have stood still for `CONFIRM_S` seconds of the
  observer's own clock, which nobody sets. Until then the owner counts as alive.
- A file without a signature is free when it is older than `_UNSIGNED_S` seconds. Its creator signs
  it at once and looks for other owners only then: if it was killed or suspended in between, it does
  not hold the lock yet. Dated in the future, such a file is watched like the others.
- The owner of a file that can't be read now counts as alive.

Watching waits for nothing: `acquire` and `holders` look at a file, and what they have seen counts
at the next look of this process. Between two looks at most `BEAT_S` seconds are counted, so that a
file server that answers nobody for a while makes no owner dead before its next heartbeat. A process
that has watched long enough can tell another one by `confirmed`.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import socket
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from enum import Enum
from time import monotonic
from typing import TYPE_CHECKING

from xrgs.runtime import processes
from xrgs.runtime.progress import format_duration
from xrgs.safeio import untrusted
from xrgs.safeio.confined import ConfinedPath, RootMissingError, confined, is_passing
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Container
    from pathlib import Path

#: Seconds between two heartbeats, and seconds without one after which an owner on another machine
#: may be dead.
BEAT_S = 30.0
SILENT_S = 600.0
#: Seconds that a watched file has to stand still: two heartbeats, and a margin.
CONFIRM_S = 65.0
#: Seconds that a file may be dated in the future: file servers and caches are not exact.
_AHEAD_S = 5.0
#: Seconds that a lock file may be without its owner's signature.
_UNSIGNED_S = 30.0
#: Bytes of a lock's file, filled with spaces so that each heartbeat replaces all of it at once; and
#: the most that is read.
_BYTES, _MAX_BYTES = 1024, 4096


class _State(Enum):
    """What is known of the owner of a lock's file."""

    ALIVE = 1
    WATCHED = 2
    """It counts as alive until it was watched long enough."""
    DEAD = 3
    RELEASED = 4
    """The file is gone, or is another owner's now."""


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
        if processes.started(self.pid) == self.started:
            return True
        return bool(self.worker) and processes.started(self.worker) == self.worker_started

    @property
    def here(self) -> bool:
        """Whether its processes would run on this machine, boot and process namespace."""
        return (self.host, self.boot) == (socket.gethostname(), processes.boot())

    def __str__(self) -> str:
        return f"process {self.pid} on {for_line(self.host)}"


@dataclass
class Lock:
    """A lock that this process holds until `release`."""

    path: ConfinedPath
    """The lock's file."""
    beaten: float
    """When the last heartbeat was given, seconds of the monotonic clock."""
    owner: Owner
    """The signature of this process in the file."""
    beats: int = 0
    """Number of heartbeats so far."""

    def beat(self, worker: int = 0) -> bool:
        """Give a heartbeat if one is due.

        Args:
            worker: Id of the child process that works under the lock, 0 if there is none. From now
                on the child is an owner as well.

        Returns:
            False if the lock is lost: this process was suspended or cut off from the store for so
            long that another one has taken over. The cell's files are the other one's then.

        Raises:
            RootMissingError: The store is no longer there.
        """
        owner = self.owner
        if worker != owner.worker:
            began = processes.started(worker) or 0
            owner = replace(owner, worker=worker, worker_started=began)
        elif monotonic() - self.beaten < BEAT_S:
            return True
        self.beaten = monotonic()
        try:
            return self._write(owner) and self._is_last()
        except RootMissingError:
            raise
        except FileNotFoundError:
            return False
        except OSError:  # the store is out of reach for now; a later heartbeat decides
            return True

    def _write(self, owner: Owner) -> bool:
        """Write the signature with the next count; return False if the file is another owner's."""
        with self.path.update() as stream:
            if _parse(stream.read(_MAX_BYTES)) not in {None, self.owner}:
                return False
            self.beats += 1
            stream.seek(0)
            stream.write(_text(owner, self.beats))
        self.owner = owner
        return True

    def _is_last(self) -> bool:
        name, generation = _parts(self.path)
        return max(_generations(self.path.parent, name), default=generation) == generation

    def is_held(self) -> bool:
        """Give a heartbeat though none is due; return as `beat`, and raise as it does."""
        self.beaten = -BEAT_S
        return self.beat(self.owner.worker)

    def release(self) -> None:
        """Release the lock, unless it was lost to another owner."""
        with suppress(OSError):  # a file that is left behind is dead when this process has ended
            if signature(self.path) == self.owner:
                self.path.unlink()


def acquire(folder: ConfinedPath, name: str, dead: Container[str] = ()) -> Lock | None:
    """Take a lock, unless an owner holds it that is alive or is still watched.

    Args:
        folder: The folder of the locks.
        name: The lock's name.
        dead: What `confirmed` gave to another process for this name.

    Returns:
        The lock; None if another owner holds it.

    Raises:
        OSError: The folder can't be read or written.
    """
    taken = {_State.ALIVE, _State.WATCHED}
    while True:
        files = _generations(folder, name)
        if any(_look(file, dead)[0] in taken for file in files.values()):
            return None
        file = folder / f"{name}.{max(files, default=-1) + 1}"
        try:
            owner = sign(file)
        except FileExistsError:
            continue  # another contender was faster: list the files again
        # The list above may be outdated. A contender that came since is found by listing once more:
        # of two, at least one sees the other. If both give way, nothing is lost but a try.
        others = [other for other in _generations(folder, name).values() if other != file]
        states = [(other, _look(other, dead)[0]) for other in others]
        if any(state in taken for _, state in states):
            file.unlink(missing_ok=True)
            return None
        for other, state in states:
            # A released lock may exist again, with a new owner. One that can't be removed is dead
            # for the next process as well.
            if state is _State.DEAD:
                with suppress(OSError):
                    other.unlink()
        return Lock(file, monotonic(), owner)


def names(folder: ConfinedPath) -> set[str]:
    """Return the names of all locks in a folder, whether their owners are alive or not.

    Args:
        folder: The folder of the locks.

    Raises:
        OSError: The folder can't be read.
    """
    return {file.stem for file in folder.iterdir() if file.suffix[1:].isdecimal()}


def holders(folder: ConfinedPath) -> dict[str, str]:
    """Return a description of the owner of each lock in a folder that is not known to be dead.

    Owners that may be dead are watched from then on.

    Args:
        folder: The folder of the locks, which need not exist.

    Returns:
        Descriptions for people, by the name of the lock.
    """
    found = {}
    for file in _files(folder):
        state, age = _look(file)
        if state in {_State.ALIVE, _State.WATCHED}:
            owner = str(signature(file) or "a process that has not signed its lock yet")
            found[_parts(file)[0]] = owner + (_silent(age) if state is _State.WATCHED else "")
    return found


def _silent(age: float) -> str:
    if age < 0:
        return f", whose lock is dated {format_duration(-age)} in the future; it may be dead"
    return f", silent for {format_duration(age)}; it may be dead"


def confirmed(folder: ConfinedPath) -> dict[str, tuple[str, ...]]:
    """Return which locks' owners are dead as far as this process has watched them.

    Args:
        folder: The folder of the locks, which need not exist.

    Returns:
        By the name of the lock what `acquire` takes for `dead`. It holds for a file as it was seen,
        and not after another heartbeat.
    """
    found: dict[str, tuple[str, ...]] = {}
    for file in _files(folder):
        with suppress(OSError):
            stamp = _stamp(file, file.read_bytes(_MAX_BYTES))
            if _look(file)[0] is _State.DEAD:
                name = _parts(file)[0]
                found[name] = (*found.get(name, ()), stamp)
    return found


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
            stream.write(_text(owner, 0))
            stream.flush()
        except BaseException:
            file.unlink(missing_ok=True)
            raise
    return owner


def signature(path: Path | ConfinedPath) -> Owner | None:
    """Return the owner that a file names; None if it does not name one or can't be read now.

    Args:
        path: A file that `sign` has created.
    """
    try:
        return _parse(confined(path).read_bytes(_MAX_BYTES))
    except OSError:
        return None


def _text(owner: Owner, beats: int) -> bytes:
    return json.dumps(asdict(owner) | {"beats": beats}).encode().ljust(_BYTES - 1) + b"\n"


def _parse(content: bytes) -> Owner | None:
    try:
        values = untrusted.parse_json(content)
        values.pop("beats", None)
        owner = Owner(**values)
    except (AttributeError, TypeError, ValueError):
        return None
    texts = {"host", "boot"}
    valid = all(type(v) is (str if k in texts else int) for k, v in vars(owner).items())
    return owner if valid else None


def _stamp(file: ConfinedPath, content: bytes) -> str:
    return f"{file.name} {hashlib.sha256(content).hexdigest()}"


def _parts(file: ConfinedPath) -> tuple[str, int]:
    """Return the name and the generation of a lock's file."""
    return file.stem, int(file.suffix[1:])


def _files(folder: ConfinedPath) -> list[ConfinedPath]:
    """Return the files of all locks; none where the folder can't be read."""
    try:
        return [file for file in folder.iterdir() if file.suffix[1:].isdecimal()]
    except OSError:
        return []


def _generations(folder: ConfinedPath, name: str) -> dict[int, ConfinedPath]:
    files = (file for file in folder.iterdir() if file.stem == name)
    return {_parts(file)[1]: file for file in files if file.suffix[1:].isdecimal()}


def _look(file: ConfinedPath, dead: Container[str] = ()) -> tuple[_State, float]:
    """Return what is known of a lock's owner, and the seconds since the file changed, 0 if here."""
    try:
        content, status = file.read_bytes(_MAX_BYTES), file.lstat()
    except FileNotFoundError:
        return _State.RELEASED, 0.0
    except OSError as error:
        # A folder, a link or a pipe is no lock: no process holds anything by it.
        return (_State.ALIVE if is_passing(error) else _State.DEAD), 0.0
    owner = _parse(content)
    if owner is None or not owner.here:
        age = _now(file.parent) - status.st_mtime
        known_dead = _stamp(file, content) in dead
        return _judged(owner, age, known_dead, status, content), age
    if owner.lives:
        return _State.ALIVE, 0.0
    return (_State.DEAD if signature(file) == owner else _State.RELEASED), 0.0


def _judged(
    owner: Owner | None, age: float, known_dead: bool, status: os.stat_result, content: bytes
) -> _State:
    """Return the state of a file that is not of an owner in the same place."""
    if -_AHEAD_S <= age < (_UNSIGNED_S if owner is None else SILENT_S):
        return _State.ALIVE
    if (owner is None and age > 0) or known_dead or _stands_still(status, content):
        return _State.DEAD
    return _State.WATCHED


@dataclass
class _Watch:
    """What this process has seen of a file that does not say whether its owner is alive."""

    seen: tuple[int, bytes]
    """Its time, in nanoseconds, and its content."""
    looked: float
    """When it was looked at last, seconds of the monotonic clock."""
    still: float = 0.0
    """Seconds that it has stood still."""


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
    pid = os.getpid()
    return Owner(socket.gethostname(), processes.boot(), pid, processes.started(pid) or 0)
