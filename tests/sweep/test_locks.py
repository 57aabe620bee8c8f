"""Tests that a cell has one owner, though processes are killed and machines disappear."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import pytest

from xrgs.sweep import locks

_TAKE = """
import sys, time
from pathlib import Path
from xrgs.sweep import locks
print(locks.acquire(Path(sys.argv[1]), "cell") is not None, flush=True)
time.sleep(600)
"""
_TAKE_FOR_A_WORKER = """
import subprocess, sys
from pathlib import Path
from xrgs.sweep import locks
worker = subprocess.Popen(["sleep", "600"], stdout=subprocess.DEVNULL)
assert locks.acquire(Path(sys.argv[1]), "cell").beat(worker.pid)
print(worker.pid)
"""
_TAKE_AND_GIVE = """
import sys, time
from pathlib import Path
from xrgs.sweep import locks
folder, log = Path(sys.argv[1]), Path(sys.argv[2])
end = time.monotonic() + 3
while time.monotonic() < end:
    lock = locks.acquire(folder, "cell")
    if lock is not None:
        start = time.monotonic_ns()
        time.sleep(0.002)
        with log.open("a") as stream:
            stream.write(f"{start} {time.monotonic_ns()}\\n")
        lock.release()
"""


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lock `cell`."""
    command = [sys.executable, "-c", _TAKE, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        yield process
        process.kill()


def elsewhere(file: Path, age: float) -> None:
    """Make a lock look like one of another machine, whose last heartbeat is `age` seconds old."""
    owner = locks.Owner(**json.loads(file.read_text()))
    file.write_text(json.dumps(asdict(replace(owner, host="elsewhere", pid=1))))
    then = time.time() - age
    os.utime(file, (then, then))


def test_a_lock_has_one_owner_until_it_is_released(tmp_path: Path) -> None:
    lock = locks.acquire(tmp_path, "cell")
    assert lock is not None
    assert locks.acquire(tmp_path, "cell") is None
    assert locks.acquire(tmp_path, "other") is not None
    assert str(os.getpid()) in str(locks.holders(tmp_path)["cell"])
    lock.release()
    assert set(locks.holders(tmp_path)) == {"other"}
    assert locks.acquire(tmp_path, "cell") is not None


def test_a_stopped_process_keeps_its_lock_and_a_killed_one_loses_it(
    tmp_path: Path, owner: subprocess.Popen[str]
) -> None:
    assert locks.acquire(tmp_path, "cell") is None
    assert locks.holders(tmp_path)["cell"] is not None
    os.kill(owner.pid, signal.SIGSTOP)
    assert locks.acquire(tmp_path, "cell") is None
    owner.kill()  # and nobody waits for it: a zombie is dead
    end = time.monotonic() + 10
    while locks.holders(tmp_path) and time.monotonic() < end:
        time.sleep(0.01)
    assert locks.acquire(tmp_path, "cell") is not None
    assert [file.name for file in tmp_path.iterdir()] == ["cell.1"]


def test_a_process_id_that_is_reused_is_another_process(tmp_path: Path) -> None:
    lock = locks.acquire(tmp_path, "cell")
    assert lock is not None
    owner = json.loads(lock.path.read_text())
    lock.path.write_text(json.dumps(owner | {"started": owner["started"] - 1}))
    assert not locks.holders(tmp_path)
    assert locks.acquire(tmp_path, "cell") is not None


def test_an_owner_on_another_machine_is_alive_as_long_as_its_heartbeats(tmp_path: Path) -> None:
    lock = locks.acquire(tmp_path, "cell")
    assert lock is not None
    elsewhere(lock.path, locks.SILENT_S - 60)
    assert locks.acquire(tmp_path, "cell") is None
    elsewhere(lock.path, locks.SILENT_S + 60)
    assert locks.acquire(tmp_path, "cell") is not None


@pytest.mark.parametrize("text", ["", "{"])
def test_a_lock_that_stays_unsigned_is_free_after_a_while(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cell.0"
    file.write_text(text)
    assert locks.acquire(tmp_path, "cell") is None  # it may be about to
    then = time.time() - 31
    os.utime(file, (then, then))
    assert locks.acquire(tmp_path, "cell") is not None


def test_an_interrupted_owner_leaves_no_unsigned_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(json, "dumps", interrupted)
    with pytest.raises(KeyboardInterrupt):
        locks.acquire(tmp_path, "cell")
    assert not list(tmp_path.iterdir())


def test_a_worker_that_outlives_its_owner_holds_the_lock_until_it_ends(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _TAKE_FOR_A_WORKER, str(tmp_path)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    worker = int(done.stdout)
    try:
        assert locks.acquire(tmp_path, "cell") is None  # its owner is no more
        assert locks.holders(tmp_path)
    finally:
        os.kill(worker, signal.SIGKILL)
    end = time.monotonic() + 10
    while locks.holders(tmp_path) and time.monotonic() < end:
        time.sleep(0.01)
    lock = locks.acquire(tmp_path, "cell")
    assert lock is not None
    assert lock.beat(os.getpid())
    lock.release()
    assert not list(tmp_path.iterdir())


def test_a_heartbeat_is_given_when_due_and_a_lost_lock_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = locks.acquire(tmp_path, "cell")
    assert lock is not None
    os.utime(lock.path, (0, 0))
    assert lock.beat()
    assert lock.path.stat().st_mtime == 0  # none is due yet
    monkeypatch.setattr(locks, "BEAT_S", 0.0)
    assert lock.beat()
    assert lock.path.stat().st_mtime > 0
    elsewhere(lock.path, 2 * locks.SILENT_S)  # suspended for long, as another machine sees it
    other = locks.acquire(tmp_path, "cell")
    assert other is not None
    assert not lock.beat()
    lock.release()
    assert other.beat()
    other.release()
    assert not other.beat()


def test_a_lost_lock_leaves_its_successor_s_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a take-over and a release the first generation is free again, for a third owner."""
    lost = locks.acquire(tmp_path, "cell")
    assert lost is not None
    lost.path.unlink()
    third = locks.acquire(tmp_path, "cell")
    assert third is not None
    assert third.path == lost.path
    elsewhere(third.path, 0)
    signature = third.path.read_text()
    monkeypatch.setattr(locks, "BEAT_S", 0.0)
    assert not lost.beat(os.getpid())
    lost.release()
    assert third.path.read_text() == signature


def test_a_heartbeat_notices_a_newer_generation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A successor creates its own file first, and deletes the lost one only then."""
    lost = locks.acquire(tmp_path, "cell")
    assert lost is not None
    monkeypatch.setattr(locks, "BEAT_S", 0.0)
    assert lost.beat()
    locks.sign(tmp_path / "cell.1")
    assert lost.path.exists()
    assert not lost.beat()


def test_a_full_disk_leaves_no_lock_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(json, "dumps", full)
    with pytest.raises(OSError, match="No space"):
        locks.acquire(tmp_path, "cell")
    assert not list(tmp_path.iterdir())


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One contender gives way and another one comes, while a third looks for dead locks."""
    contender, looks, living = tmp_path / "cell.1", 0, locks._living

    def generations(folder: Path, name: str) -> dict[int, Path]:
        nonlocal looks
        looks += 1
        return {1: contender} if looks == 2 else {}  # it has come and gone

    def seen(file: Path) -> bool | None:
        found = living(file)
        locks.sign(file)
        return found

    monkeypatch.setattr(locks, "_generations", generations)
    monkeypatch.setattr(locks, "_living", seen)
    lock = locks.acquire(tmp_path, "cell")
    assert lock is not None
    assert lock.path.name == "cell.0"
    assert contender.exists()
