"""Tests that a cell has one owner, though processes are killed and machines disappear."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from xrgs.safeio.confined import ConfinedPath, RootMissingError
from xrgs.sweep import locks

_TAKE = """
import sys, time
from pathlib import Path
from xrgs.safeio.confined import ConfinedPath
from xrgs.sweep import locks
print(locks.acquire(ConfinedPath(Path(sys.argv[1])), "cell") is not None, flush=True)
time.sleep(600)
"""
_TAKE_FOR_A_WORKER = """
import subprocess, sys
from pathlib import Path
from xrgs.safeio.confined import ConfinedPath
from xrgs.sweep import locks
worker = subprocess.Popen(["sleep", "600"], stdout=subprocess.DEVNULL)
assert locks.acquire(ConfinedPath(Path(sys.argv[1])), "cell").beat(worker.pid)
print(worker.pid)
"""
_TAKE_AND_GIVE = """
import sys, time
from pathlib import Path
from xrgs.safeio.confined import ConfinedPath
from xrgs.sweep import locks
folder, log = Path(sys.argv[1]), Path(sys.argv[2])
end = time.monotonic() + 3
while time.monotonic() < end:
    lock = locks.acquire(ConfinedPath(folder), "cell")
    if lock is not None:
        start = time.monotonic_ns()
        time.sleep(0.002)
        with log.open("a") as stream:
            stream.write(f"{start} {time.monotonic_ns()}\\n")
        lock.release()
"""


class Clock:
    """Stands in for the monotonic clock of this process."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """A clock that stands still until it is set."""
    clock = Clock()
    monkeypatch.setattr(locks, "monotonic", clock)
    monkeypatch.setattr(locks, "_watches", {})
    return clock


@pytest.fixture
def folder(tmp_path: Path) -> ConfinedPath:
    """The folder of the locks."""
    return ConfinedPath(tmp_path)


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lock `cell`."""
    command = [sys.executable, "-c", _TAKE, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        yield process
        process.kill()


def dated(file: Path, age: float) -> None:
    """Set a file's time to what it was `age` seconds ago; in the future where that is negative."""
    then = time.time() - age
    os.utime(file, (then, then))


def elsewhere(file: Path, age: float) -> None:
    """Make a lock look like one of another machine, whose last heartbeat is `age` seconds old."""
    values = json.loads(file.read_text())
    file.write_text(json.dumps(values | {"host": "elsewhere", "pid": 1}))
    dated(file, age)


def beat_elsewhere(file: Path, age: float) -> None:
    """Give a heartbeat on another machine, which a file server of a strange clock dates."""
    values = json.loads(file.read_text())
    file.write_text(json.dumps(values | {"beats": values["beats"] + 1}))
    dated(file, age)


def watch(folder: ConfinedPath, clock: Clock, seconds: float, step: float = 5.0) -> None:
    """Look at all locks again and again, as a sweep does."""
    end = clock.now + seconds
    while clock.now < end:
        clock.now = min(end, clock.now + step)
        locks.holders(folder)


def test_a_lock_has_one_owner_until_it_is_released(folder: ConfinedPath) -> None:
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    assert locks.acquire(folder, "cell") is None
    assert locks.acquire(folder, "other") is not None
    assert str(os.getpid()) in str(locks.holders(folder)["cell"])
    lock.release()
    assert set(locks.holders(folder)) == locks.names(folder) == {"other"}
    assert locks.acquire(folder, "cell") is not None


def test_a_stopped_process_keeps_its_lock_and_a_killed_one_loses_it(
    folder: ConfinedPath, owner: subprocess.Popen[str]
) -> None:
    assert locks.acquire(folder, "cell") is None
    assert locks.holders(folder)["cell"] is not None
    os.kill(owner.pid, signal.SIGSTOP)
    assert locks.acquire(folder, "cell") is None
    owner.kill()  # and nobody waits for it: a zombie is dead
    end = time.monotonic() + 10
    while locks.holders(folder) and time.monotonic() < end:
        time.sleep(0.01)
    assert locks.acquire(folder, "cell") is not None
    assert folder.names() == ["cell.1"]


def test_a_process_id_that_is_reused_is_another_process(folder: ConfinedPath) -> None:
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    file = lock.path.path
    owner = json.loads(file.read_text())
    file.write_text(json.dumps(owner | {"started": owner["started"] - 1}))
    assert not locks.holders(folder)
    assert locks.acquire(folder, "cell") is not None


@pytest.fixture
def taken(folder: ConfinedPath) -> Path:
    """The file of the lock `cell`, which this process has taken."""
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    return lock.path.path


@pytest.mark.parametrize("age", [-4.0, 0.0, locks.SILENT_S - 60])
def test_an_owner_on_another_machine_is_alive_while_its_file_is_young(
    folder: ConfinedPath, taken: Path, clock: Clock, age: float
) -> None:
    elsewhere(taken, age)
    watch(folder, clock, 10 * locks.CONFIRM_S)
    assert locks.acquire(folder, "cell") is None
    assert locks.holders(folder) == {"cell": "process 1 on elsewhere"}


#: Ages of a file whose owner may be dead: silent, of another era, or dated in the future.
_STRANGE = [locks.SILENT_S + 60, 1e9, -60.0, -3600.0, -1e9]


@pytest.mark.parametrize("age", _STRANGE)
def test_a_dead_owner_of_any_date_is_taken_over_once_it_was_watched(
    folder: ConfinedPath, taken: Path, clock: Clock, age: float
) -> None:
    elsewhere(taken, age)
    assert "it may be dead" in locks.holders(folder)["cell"]
    watch(folder, clock, locks.CONFIRM_S - 1)
    assert locks.acquire(folder, "cell") is None
    assert locks.holders(folder)
    assert not locks.confirmed(folder)
    watch(folder, clock, 1)
    assert not locks.holders(folder)
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    assert folder.names() == ["cell.1"]


@pytest.mark.parametrize("age", _STRANGE)
def test_a_live_owner_with_a_strange_clock_is_never_robbed(
    folder: ConfinedPath, taken: Path, clock: Clock, age: float
) -> None:
    elsewhere(taken, age)
    for _ in range(50):
        watch(folder, clock, locks.BEAT_S)
        beat_elsewhere(taken, age)  # the file has the same date after each heartbeat
        assert locks.acquire(folder, "cell") is None
    watch(folder, clock, locks.CONFIRM_S - 1)
    assert locks.acquire(folder, "cell") is None  # it is watched from its last heartbeat on
    watch(folder, clock, 1)
    assert locks.acquire(folder, "cell") is not None


@pytest.mark.parametrize("jump", [-1e6, -1000.0, 1000.0, 1e6])
def test_a_server_clock_that_is_set_during_a_hold_robs_nobody_and_frees_the_dead(
    folder: ConfinedPath,
    taken: Path,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    jump: float,
) -> None:
    elsewhere(taken, 10)
    assert locks.acquire(folder, "cell") is None
    monkeypatch.setattr(locks, "_now", lambda _: time.time() + jump)
    for _ in range(10):
        watch(folder, clock, locks.BEAT_S)
        beat_elsewhere(taken, 10)  # it is dated by the old clock, as by a cache
        assert locks.acquire(folder, "cell") is None
    beat_elsewhere(taken, -jump)  # and by the new one
    watch(folder, clock, 10 * locks.CONFIRM_S)
    assert locks.acquire(folder, "cell") is None  # young, by the clock that was set
    dated(taken, 10)
    watch(folder, clock, locks.CONFIRM_S + 5)
    assert locks.acquire(folder, "cell") is not None


def test_a_heartbeat_that_moves_the_time_alone_is_a_sign_of_life(
    folder: ConfinedPath, taken: Path, clock: Clock
) -> None:
    """On a full disk the content may stay, and an older version counted no heartbeats."""
    elsewhere(taken, 1e6)
    for beats in range(20):
        watch(folder, clock, locks.BEAT_S)
        dated(taken, 1e6 - beats)
        assert locks.acquire(folder, "cell") is None


def test_time_in_which_nobody_looks_makes_no_owner_dead(
    folder: ConfinedPath, taken: Path, clock: Clock
) -> None:
    """A file server that answers nobody stops the owner's heartbeats and the observer alike."""
    elsewhere(taken, 1e6)
    locks.holders(folder)
    clock.now += 1e5
    assert locks.acquire(folder, "cell") is None
    watch(folder, clock, locks.BEAT_S)
    assert locks.acquire(folder, "cell") is None
    watch(folder, clock, locks.BEAT_S)
    assert locks.acquire(folder, "cell") is not None


def test_what_one_process_has_watched_another_one_acts_on(
    folder: ConfinedPath, taken: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere(taken, -1e6)
    watch(folder, clock, locks.CONFIRM_S + 5)
    dead = locks.confirmed(folder)
    assert dead.keys() == {"cell"}
    monkeypatch.setattr(locks, "_watches", {})  # another process has watched nothing
    before = taken.read_text()
    beat_elsewhere(taken, -1e6)
    assert locks.acquire(folder, "cell", dead["cell"]) is None  # it was alive after all
    taken.write_text(before)
    dated(taken, -1e6)
    assert locks.acquire(folder, "cell") is None
    assert locks.acquire(folder, "cell", dead["cell"]) is not None


@pytest.mark.parametrize("text", ["", "{", "[]", "x" * 5])
def test_a_lock_that_stays_unsigned_is_free_after_a_while(
    folder: ConfinedPath, clock: Clock, text: str
) -> None:
    file = folder.path / "cell.0"
    file.write_text(text)
    assert locks.acquire(folder, "cell") is None  # it may be about to be signed
    assert "not signed" in locks.holders(folder)["cell"]
    dated(file, -1e6)
    assert locks.acquire(folder, "cell") is None
    watch(folder, clock, locks.CONFIRM_S + 5)
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    lock.release()
    file.write_text(text)
    dated(file, 31)
    assert locks.acquire(folder, "cell") is not None


def test_a_lock_that_can_not_be_read_now_is_held(
    folder: ConfinedPath, taken: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that fails for a moment robs nobody."""
    elsewhere(taken, 1e6)
    watch(folder, clock, locks.CONFIRM_S + 5)
    read = ConfinedPath.read_bytes

    def sick(path: ConfinedPath, *given: int) -> bytes:
        if path.name == "cell.0":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return read(path, *given)

    with monkeypatch.context() as patch:
        patch.setattr(ConfinedPath, "read_bytes", sick)
        assert locks.acquire(folder, "cell") is None
        assert locks.holders(folder)
    assert locks.acquire(folder, "cell") is not None


@pytest.mark.parametrize("kind", ["link", "pipe", "folder", "too large"])
def test_what_is_no_file_of_ours_is_no_lock(folder: ConfinedPath, kind: str) -> None:
    file = folder.path / "cell.0"
    if kind == "link":
        file.symlink_to(folder.path / "elsewhere")
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    else:
        file.write_bytes(bytes(10_000))
    assert locks.acquire(folder, "cell") is not None
    assert not (folder.path / "elsewhere").exists()


def test_a_name_of_a_machine_obeys_no_terminal(folder: ConfinedPath, taken: Path) -> None:
    values = json.loads(taken.read_text())
    taken.write_text(json.dumps(values | {"host": "a\x1b[31mb\nc"}))
    assert re.fullmatch(r"process \d+ on a \[31mb c", locks.holders(folder)["cell"])


def test_an_interrupted_owner_leaves_no_unsigned_lock(
    folder: ConfinedPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(json, "dumps", interrupted)
    with pytest.raises(KeyboardInterrupt):
        locks.acquire(folder, "cell")
    assert not folder.names()


def test_a_worker_that_outlives_its_owner_holds_the_lock_until_it_ends(
    folder: ConfinedPath,
) -> None:
    command = [sys.executable, "-c", _TAKE_FOR_A_WORKER, str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    worker = int(done.stdout)
    try:
        assert locks.acquire(folder, "cell") is None  # its owner is no more
        assert locks.holders(folder)
    finally:
        os.kill(worker, signal.SIGKILL)
    end = time.monotonic() + 10
    while locks.holders(folder) and time.monotonic() < end:
        time.sleep(0.01)
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    assert lock.beat(os.getpid())
    lock.release()
    assert not folder.names()


def beats(file: Path) -> int:
    return int(json.loads(file.read_text())["beats"])


def test_a_heartbeat_is_counted_when_it_is_due(folder: ConfinedPath, clock: Clock) -> None:
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    file = lock.path.path
    os.utime(file, (0, 0))
    inode, size = file.stat().st_ino, file.stat().st_size
    assert lock.beat()
    assert (beats(file), file.stat().st_mtime) == (0, 0)  # none is due yet
    clock.now += locks.BEAT_S
    assert lock.beat()
    assert beats(file) == 1
    assert file.stat().st_mtime > 0
    assert lock.beat(os.getpid())  # a child is named at once
    assert beats(file) == 2
    assert json.loads(file.read_text())["worker"] == os.getpid()
    assert lock.is_held()
    assert beats(file) == 3
    assert (file.stat().st_ino, file.stat().st_size) == (inode, size)


def test_a_lock_that_was_taken_over_is_lost_and_its_successor_s_is_not_touched(
    folder: ConfinedPath, clock: Clock
) -> None:
    lost = locks.acquire(folder, "cell")
    assert lost is not None
    elsewhere(lost.path.path, 2 * locks.SILENT_S)  # suspended for long, as another machine sees it
    watch(folder, clock, locks.CONFIRM_S + 5)
    other = locks.acquire(folder, "cell")
    assert other is not None
    before = other.path.path.read_bytes()
    assert not lost.beat()
    assert not lost.is_held()
    assert not lost.beat(os.getpid())
    lost.release()
    assert folder.names() == ["cell.1"]
    assert other.path.path.read_bytes() == before
    assert other.is_held()
    other.release()
    assert not other.is_held()
    assert not folder.names()


def test_a_lost_lock_leaves_its_successor_s_file_alone(folder: ConfinedPath, clock: Clock) -> None:
    """After a take-over and a release the first generation is free again, for a third owner."""
    lost = locks.acquire(folder, "cell")
    assert lost is not None
    lost.path.unlink()
    third = locks.acquire(folder, "cell")
    assert third is not None
    assert third.path == lost.path
    elsewhere(third.path.path, 0)
    signature = third.path.read_text()
    assert not lost.is_held()
    assert not lost.beat(os.getpid())
    lost.release()
    assert third.path.read_text() == signature


def test_a_heartbeat_notices_a_newer_generation(folder: ConfinedPath, clock: Clock) -> None:
    """A successor creates its own file first, and deletes the lost one only then."""
    lost = locks.acquire(folder, "cell")
    assert lost is not None
    assert lost.is_held()
    locks.sign(folder / "cell.1")
    assert lost.path.exists()
    assert not lost.is_held()


def test_a_heartbeat_into_a_store_out_of_reach_decides_nothing(
    folder: ConfinedPath, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = locks.acquire(folder, "cell")
    assert lock is not None

    def stale(path: ConfinedPath) -> None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(ConfinedPath, "update", stale)
        assert lock.is_held()
    assert lock.is_held()


def test_a_heartbeat_creates_nothing_where_the_store_is_gone(tmp_path: Path) -> None:
    (tmp_path / "s" / "locks").mkdir(parents=True)
    folder = ConfinedPath(tmp_path / "s") / "locks"
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    (tmp_path / "s").rename(tmp_path / "moved")
    with pytest.raises(RootMissingError):
        lock.is_held()
    lock.release()
    assert not locks.holders(folder)
    assert not locks.confirmed(folder)
    with pytest.raises(RootMissingError):
        locks.acquire(folder, "other")
    assert [file.name for file in tmp_path.iterdir()] == ["moved"]


def test_a_full_disk_leaves_no_lock_behind(
    folder: ConfinedPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(json, "dumps", full)
    with pytest.raises(OSError, match="No space"):
        locks.acquire(folder, "cell")
    assert not folder.names()


@pytest.mark.slow
def test_of_many_contenders_one_has_the_lock(tmp_path: Path, owner: subprocess.Popen[str]) -> None:
    """The first of them take over from a dead owner at the same time."""
    owner.kill()
    owner.wait()
    log = tmp_path / "log"
    command = [sys.executable, "-c", _TAKE_AND_GIVE, str(tmp_path), str(log)]
    processes = [subprocess.Popen(command) for _ in range(6)]
    assert [process.wait() for process in processes] == [0] * 6
    spans = sorted(tuple(map(int, line.split())) for line in log.read_text().splitlines())
    assert len(spans) > 20
    for (_, end), (start, _) in pairwise(spans):
        assert end <= start


def test_a_lock_that_is_created_again_meanwhile_is_not_taken_for_the_dead_one(
    folder: ConfinedPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One contender gives way and another one comes, while a third looks for dead locks."""
    contender, listed, look = folder / "cell.1", 0, locks._look

    def generations(*_: object) -> dict[int, ConfinedPath]:
        nonlocal listed
        listed += 1
        return {1: contender} if listed == 2 else {}  # it has come and gone

    def seen(file: ConfinedPath, *given: Any) -> Any:
        found = look(file, *given)
        locks.sign(file)
        return found

    monkeypatch.setattr(locks, "_generations", generations)
    monkeypatch.setattr(locks, "_look", seen)
    lock = locks.acquire(folder, "cell")
    assert lock is not None
    assert lock.path.name == "cell.0"
    assert contender.exists()
