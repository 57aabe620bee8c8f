"""Cells that raise, are killed, crash, hang or eat all memory, in sweeps of real processes.

The faults come from a `sitecustomize` of the test's own, which Python loads in every process: in a
cell's child it stands in for `xrgs.cell`, and does to cells of some seeds what the test names.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=4", "threads=1", "store=s")
FAULTS = """
import sys
if "xrgs.worker" in sys.orig_argv and "cell" in sys.orig_argv:
    import ctypes, errno, importlib, os, signal, subprocess, time, types
    from pathlib import Path

    def real():
        sys.modules.pop("xrgs.cell", None)
        return importlib.import_module("xrgs.cell")

    def raises(*arguments):
        cell = real()
        def load(*_):
            raise RuntimeError("this cell raises")
        cell.dataset.load = load
        cell.run(*arguments)

    def hangs(*_):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
        Path("pids").write_text(f"{os.getpid()} {child.pid}")
        time.sleep(600)

    def eats(*_):
        eaten = []
        while True:
            eaten.append(b"x" * 20_000_000)
            time.sleep(0.02)

    def finds_the_disk_full(*arguments):
        def fsync(_):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync = fsync
        real().run(*arguments)

    def run(conf, variant, folder):
        fault = {
            1: raises,
            2: lambda *_: os.kill(os.getpid(), signal.SIGKILL),
            3: lambda *_: ctypes.string_at(0),
            4: hangs,
            5: eats,
            6: finds_the_disk_full,
        }.get(conf.seed)
        if fault is None:
            real().run(conf, variant, folder)
        else:
            fault(conf, variant, folder)

    sys.modules["xrgs.cell"] = types.ModuleType("xrgs.cell")
    sys.modules["xrgs.cell"].run = run
"""


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-c", "from xrgs.cli import sweep; sweep()", *SMOKE, *arguments]


def environment(folder: Path, *, faults: bool) -> dict[str, str]:
    if not faults:
        return dict(os.environ)
    (folder / "site").mkdir(exist_ok=True)
    (folder / "site" / "sitecustomize.py").write_text(FAULTS)
    path = os.pathsep.join([str(folder / "site"), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"PYTHONPATH": path}


def run(folder: Path, *arguments: str, faults: bool = True) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a sweep."""
    done = subprocess.run(
        command(*arguments),
        cwd=folder,
        env=environment(folder, faults=faults),
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def cells(folder: Path) -> dict[int, Path]:
    """Every cell by its seed."""
    found = (folder / "s" / "cells").glob("*/identity.json")
    return {json.loads(f.read_text())["seed"]: f.parent for f in found if "." not in f.parent.name}


def status(cell: Path) -> dict[str, str]:
    return dict(json.loads((cell / "status.json").read_text()))


def gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in "ZX"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A folder whose store `s` holds a sweep with one cell of each fault, and what it printed."""
    folder = tmp_path_factory.mktemp("faults")
    code, out, err = run(folder, "seed=1,2,3,5,0", "limits.memory_gb=1.5")
    assert code == 1, err
    return folder, out, err


@pytest.fixture
def folder(built: tuple[Path, str, str], tmp_path: Path) -> Path:
    """A copy of it that a test may go on with."""
    shutil.copytree(built[0] / "s", tmp_path / "s")
    return tmp_path


def test_each_fault_is_its_cell_s_status_and_the_others_finish(
    built: tuple[Path, str, str],
) -> None:
    folder, out, err = built
    found = cells(folder)
    assert status(found[0])["state"] == "done"
    reasons = {
        1: "RuntimeError: this cell raises",
        2: "its process was ended by SIGKILL",
        3: "its process was ended by SIGSEGV",
        5: "limits.memory_gb=1.5",
    }
    for seed, reason in reasons.items():
        assert status(found[seed])["state"] == "failed"
        assert reason in status(found[seed])["reason"]
        assert reason in (found[seed] / "error.txt").read_text()
        assert (found[seed] / "log.txt").is_file()
        assert reason in err
        assert reason.partition(":")[0] in out  # the table says why too
    assert "Traceback" in (found[1] / "error.txt").read_text()
    assert "Segmentation fault" in (found[3] / "log.txt").read_text()
    assert out.count("failed") >= 4
    assert not list((folder / "s" / "locks").iterdir())


def test_failed_cells_are_left_and_run_again_where_that_is_asked_for(folder: Path) -> None:
    code, out, err = run(folder, "seed=2,0", faults=False)
    assert code == 1
    assert "training cell" not in err
    assert "retry=failed" in err
    assert "SIGKILL" in out
    code, out, err = run(folder, "seed=2,0", "retry=failed", faults=False)
    assert code == 0, err
    assert err.count("training cell") == 1
    assert status(cells(folder)[2])["state"] == "done"


def test_nothing_is_started_after_a_failure_with_fail_fast(folder: Path) -> None:
    code, _, err = run(folder, "seed=1,2,7", "retry=failed", "fail_fast=true")
    assert code == 1
    assert err.count("training cell") == 1
    assert 7 not in cells(folder)


def test_a_cell_that_hangs_is_ended_at_its_limit(folder: Path) -> None:
    code, _, err = run(folder, "seed=4", "limits.minutes=0.1")
    assert code == 1
    assert "limits.minutes=0.1" in status(cells(folder)[4])["reason"]
    assert "limits.minutes=0.1" in err
    assert all(gone(int(pid)) for pid in (folder / "pids").read_text().split())


def test_a_full_disk_stops_the_sweep_and_costs_no_cell(folder: Path) -> None:
    code, _, err = run(folder, "seed=6,7,0")
    assert code == 1
    assert "No space left on device" in err
    assert "What is done is kept" in err
    assert 7 not in cells(folder)  # nothing more is tried
    assert status(cells(folder)[0])["state"] == "done"
    code, _, err = run(folder, "seed=6,7,0", faults=False)
    assert code == 0, err
    assert err.count("training cell") == 2


def test_a_killed_sweep_takes_its_cell_along_and_the_next_takes_over(folder: Path) -> None:
    with subprocess.Popen(
        command("seed=4"),
        cwd=folder,
        env=environment(folder, faults=True),
        stderr=subprocess.DEVNULL,
    ) as sweep:
        end = time.monotonic() + 60
        while not (folder / "pids").exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        _, _, err = run(folder, "seed=4", "dry_run=true")
        assert "running" in err
        assert f"by process {sweep.pid} on" in err
        sweep.send_signal(signal.SIGKILL)
    for pid in (folder / "pids").read_text().split():
        while not gone(int(pid)):
            assert time.monotonic() < end
            time.sleep(0.05)
    code, _, err = run(folder, "seed=4", faults=False)
    assert code == 0, err
    assert "unfinished" in err
    assert "waiting" not in err


def test_two_sweeps_at_once_train_each_cell_once(folder: Path) -> None:
    sweeps = [
        subprocess.Popen(
            command(seeds), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for seeds in ("seed=10,11,12", "seed=12,11,10")
    ]
    printed = [sweep.communicate() for sweep in sweeps]
    assert [sweep.returncode for sweep in sweeps] == [0, 0], printed
    assert sum(err.count("training cell") for _, err in printed) == 3
    for out, _ in printed:
        assert "failed" not in out
    assert not list((folder / "s" / "locks").iterdir())
