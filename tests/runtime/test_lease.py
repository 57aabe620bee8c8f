"""Tests that a cell has one owner, though processes are killed and machines disappear."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from xrgs.runtime import lease

_TAKE = """
import sys, time
from pathlib import Path
from xrgs.runtime import lease
print(lease.acquire(Path(sys.argv[1]), "cell") is not None, flush=True)
time.sleep(600)
"""
_TAKE_AND_GIVE = """
import sys, time
from pathlib import Path
from xrgs.runtime import lease
folder, log = Path(sys.argv[1]), Path(sys.argv[2])
end = time.monotonic() + 0.5
while time.monotonic() < end:
    held = lease.acquire(folder, "cell")
    if held is not None:
        start = time.monotonic_ns()
        time.sleep(0.002)
        with log.open("a") as stream:
            stream.write(f"{start} {time.monotonic_ns()}\\n")
        held.release()
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of the leases."""
    return tmp_path


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lease `cell`."""
    command = [sys.executable, "-c", _TAKE, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        yield process
        process.kill()


def take(folder: Path, name: str = "cell") -> lease.Lease:
    """A lease that is free."""
    held = lease.acquire(folder, name)
    assert held is not None
    return held


def dated(file: Path, age: float) -> None:
    """Set a file's time to what it was `age` seconds ago; in the future where that is negative."""
    then = time.time() - age
    os.utime(file, (then, then))


def elsewhere(file: Path, age: float) -> None:
    """Make a lease look like one of another machine, whose last heartbeat is `age` seconds old."""
    values = json.loads(file.read_text())
    file.write_text(json.dumps(values | {"host": "elsewhere", "pid": 1}))
    dated(file, age)


def test_a_lease_has_one_owner_until_it_is_released(folder: Path) -> None:
    held = take(folder)
    assert lease.acquire(folder, "cell") is None
    take(folder, "other")
    assert str(os.getpid()) in str(lease.holders(folder)["cell"])
    held.release()
    assert set(lease.holders(folder)) == lease.names(folder) == {"other"}
    take(folder)


def test_a_stopped_process_keeps_its_lease_and_a_killed_one_loses_it(
    folder: Path, owner: subprocess.Popen[str]
) -> None:
    assert lease.acquire(folder, "cell") is None
    assert lease.holders(folder)["cell"] is not None
    os.kill(owner.pid, signal.SIGSTOP)
    assert lease.acquire(folder, "cell") is None
    owner.kill()  # and nobody waits for it: a zombie is dead
    end = time.monotonic() + 10
    while lease.holders(folder) and time.monotonic() < end:
        time.sleep(0.01)
    assert lease.acquire(folder, "cell") is not None
    assert names(folder) == ["cell.1"]


@pytest.fixture
def taken(folder: Path) -> Path:
    """The file of the lease `cell`, which this process has taken."""
    return take(folder).path


@pytest.mark.parametrize(
    ("age", "alive"),
    [
        *((-60.0, True), (lease.SILENT_S - 60, True)),
        *((lease.SILENT_S + 60, False), (-lease.SILENT_S - 60, False)),
    ],
)
def test_an_owner_on_another_machine_is_alive_while_its_file_is_young(
    folder: Path, taken: Path, age: float, alive: bool
) -> None:
    """A date far in the future is of a clock that was set; a live owner would have mended it."""
    elsewhere(taken, age)
    assert lease.holders(folder) == ({"cell": "process 1 on elsewhere"} if alive else {})
    assert (lease.acquire(folder, "cell") is None) == alive
    assert names(folder) == ["cell.0" if alive else "cell.1"]


def test_an_owner_s_age_is_told_by_the_file_server_s_clock(
    folder: Path, taken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere(taken, 10)
    now = time.time() + 1e6
    monkeypatch.setattr(time, "time", lambda: now)
    assert lease.acquire(folder, "cell") is None


@pytest.mark.parametrize(("text", "seconds"), [("", 60.0), ("{", 600.0)])
def test_a_lease_that_stays_unsigned_is_free_after_a_while(
    folder: Path, text: str, seconds: float
) -> None:
    file = folder / "cell.0"
    file.write_text(text)
    assert lease.acquire(folder, "cell") is None  # it may be about to be signed
    assert "not signed" in lease.holders(folder)["cell"]
    dated(file, seconds - 10)
    assert lease.acquire(folder, "cell") is None
    dated(file, seconds + 1)
    assert lease.acquire(folder, "cell") is not None


def test_a_lease_that_can_not_be_read_is_held(
    folder: Path, taken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that fails for a moment robs nobody."""
    elsewhere(taken, 1e6)

    def sick(path: Path, *_: int) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(lease, "read_bytes", sick)
        assert lease.acquire(folder, "cell") is None
        assert lease.holders(folder)
    assert lease.acquire(folder, "cell") is not None


def test_an_interrupted_owner_leaves_no_unsigned_lease(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(json, "dumps", interrupted)
    with pytest.raises(KeyboardInterrupt):
        lease.acquire(folder, "cell")
    assert not names(folder)


def wait(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not what():
        assert time.monotonic() < end
        time.sleep(0.01)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_thread_gives_the_heartbeats_until_the_lease_is_released(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lease, "BEAT_S", 0.01)
    held = take(folder)
    for _ in range(2):
        os.utime(held.path, (0, 0))
        wait(lambda: held.path.stat().st_mtime > 0)
    held.release()
    assert not names(folder)
    assert held._ended.is_set()


def test_a_lease_that_was_taken_over_is_lost_and_its_successor_s_is_not_touched(
    folder: Path,
) -> None:
    lost = take(folder)
    elsewhere(lost.path, 2 * lease.SILENT_S)  # suspended for long, as another machine sees it
    other = take(folder)
    before = other.path.read_bytes()
    assert not lost.beat()
    assert lost.lost
    lost.release()
    assert names(folder) == ["cell.1"]
    assert other.path.read_bytes() == before
    assert other.beat()
    other.release()
    assert not other.beat()
    assert not names(folder)


def test_a_heartbeat_notices_a_newer_generation(folder: Path) -> None:
    """A successor creates its own file first, and deletes the lost one only then."""
    lost = take(folder)
    assert lost.beat()
    lease.sign(folder / "cell.1")
    assert lost.path.exists()
    assert not lost.beat()


def test_a_heartbeat_into_a_store_out_of_reach_decides_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = take(folder)

    def stale(path: Path, *_: object) -> None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(lease, "read_bytes", stale)
        assert held.beat()
    assert held.beat()


def test_a_heartbeat_creates_nothing_where_the_store_is_gone(tmp_path: Path) -> None:
    folder = tmp_path / "s" / "locks"
    folder.mkdir(parents=True)
    held = take(folder)
    (tmp_path / "s").rename(tmp_path / "moved")
    assert not held.beat()
    held.release()
    assert not lease.holders(folder)
    with pytest.raises(FileNotFoundError):
        lease.acquire(folder, "other")
    assert [file.name for file in tmp_path.iterdir()] == ["moved"]


def test_waiting_ends_when_the_owner_releases_its_lease(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first = take(folder, "scene")
    monkeypatch.setattr(time, "sleep", lambda _: first.release())
    with lease.waited_for(folder, "scene") as second:
        assert second.beat()
    assert "scene: waiting until another process has finished" in caplog.text
    assert not names(folder)


@pytest.mark.slow
def test_of_many_contenders_one_has_the_lease(tmp_path: Path, owner: subprocess.Popen[str]) -> None:
    """The first of them take over from a dead owner at the same time."""
    owner.kill()
    owner.wait()
    log = tmp_path / "log"
    command = [sys.executable, "-c", _TAKE_AND_GIVE, str(tmp_path), str(log)]
    processes = [subprocess.Popen(command) for _ in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    spans = sorted(tuple(map(int, line.split())) for line in log.read_text().splitlines())
    assert len(spans) > 20
    for (_, end), (start, _) in pairwise(spans):
        assert end <= start


def test_a_lease_that_is_created_again_meanwhile_is_not_taken_for_the_dead_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One contender gives way and another one comes, while a third looks for dead lease."""
    contender, listed, state = folder / "cell.1", 0, lease._state

    def generations(*_: object) -> dict[int, Path]:
        nonlocal listed
        listed += 1
        return {1: contender} if listed == 2 else {}  # it has come and gone

    def seen(file: Path) -> Any:
        found = state(file)
        lease.sign(file)
        return found

    monkeypatch.setattr(lease, "_generations", generations)
    monkeypatch.setattr(lease, "_state", seen)
    assert take(folder).path.name == "cell.0"
    assert contender.exists()


def test_a_process_id_that_is_reused_is_another_process(folder: Path, taken: Path) -> None:
    owner = json.loads(taken.read_text())
    taken.write_text(json.dumps(owner | {"started": owner["started"] - 10}))
    assert not lease.holders(folder)
    take(folder)


def test_a_lost_lease_leaves_its_successor_s_file_alone(folder: Path) -> None:
    """After a take-over and a release the first generation is free again, for a third owner."""
    lost = take(folder)
    lost.path.unlink()
    third = take(folder)
    assert third.path == lost.path
    elsewhere(third.path, 0)
    signature = third.path.read_text()
    assert not lost.beat()
    lost.release()
    assert third.path.read_text() == signature
