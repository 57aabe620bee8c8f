"""Tests of cells that raise, are killed, crash or hang, and of disks that are full, in real sweeps.

The faults come from a `sitecustomize` of these tests, which Python loads in every process: in a
cell's child it replaces `xrgs.store.cell`, and injects a fault into the cells of some seeds.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.sweep.conftest import content
from xrgs.store.store import Store

pytestmark = pytest.mark.slow

#: (folder, faults) -> `tests.conftest.Sweeps`.
SweepsIn = Callable[..., Any]
Ended = tuple[int, str, str]

SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=4")
#: A healthy cell writes results and ends; with a file `healed`, all are healthy.
FAULTS = """
import sys
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    import ctypes, os, signal, subprocess, time, types
    from pathlib import Path

    def trains(folder):
        from xrgs.safeio.atomic import write_json
        summary = {"training_time_s": 1.5, "render_time_ms": 2, "gaussians": 7, "steps": 4}
        write_json(folder.path / "summary.json", summary | {"memory_bytes": 1, "evaluations": 1})
        (folder.path / "scores.csv").write_text("view,psnr\\na,20\\n")
        (folder.path / "splats.ply").write_bytes(bytes(200_000))
        folder.finish(["a"], {})

    def raises(_):
        raise RuntimeError("this cell raises")

    def hangs(_):
        child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
        Path(os.environ["SWEEPS_OF"], "hangs").touch()
        time.sleep(600)

    def run_cell(conf, variant, folder, stop):
        faults = {
            1: raises,
            2: lambda _: os.kill(os.getpid(), signal.SIGKILL),
            3: lambda _: ctypes.string_at(0),
            4: hangs,
        }
        if Path(os.environ["SWEEPS_OF"], "healed").exists():
            faults = {}
        faults.get(conf.seed, trains)(folder)

    sys.modules["xrgs.store.cell"] = types.ModuleType("xrgs.store.cell")
    sys.modules["xrgs.store.cell"].run_cell = run_cell
else:  # no report is made, which takes as long as all else
    import types
    sys.modules["xrgs.report"] = types.ModuleType("xrgs.report")
    sys.modules["xrgs.report"].build = lambda *_: types.SimpleNamespace(text="")
"""


def status(cell: Path) -> dict[str, str]:
    return dict(json.loads((cell / "status.json").read_text()))


@pytest.fixture(scope="module")
def built(
    sweeps_in: SweepsIn, tmp_path_factory: pytest.TempPathFactory, smoke_variants: Path
) -> tuple[Any, Ended]:
    """A store with a sweep of a cell of most faults and a healthy one; how that ended."""
    sweeps = sweeps_in(tmp_path_factory.mktemp("faults"), FAULTS)
    shutil.copytree(smoke_variants, sweeps.folder / "s" / "variants")
    return sweeps, sweeps.run(*SMOKE, "seed=1,2,3,0")


@pytest.fixture
def sweeps(built: tuple[Any, Ended], sweeps_in: SweepsIn, tmp_path: Path) -> Any:
    """On a copy of that store."""
    shutil.copytree(built[0].folder / "s", tmp_path / "s")
    return sweeps_in(tmp_path, FAULTS)


@pytest.fixture(scope="module")
def stopped(
    built: tuple[Any, Ended], sweeps_in: SweepsIn, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Any, dict[str, Ended]]:
    """On another copy, sweeps that had a signal while a cell hung, and what they said of it."""
    sweeps = sweeps_in(tmp_path_factory.mktemp("stopped"), FAULTS)
    shutil.copytree(built[0].folder / "s", sweeps.folder / "s")
    told = {}
    for number in (signal.SIGINT, signal.SIGKILL):
        sweep = sweeps.start(*SMOKE, "seed=4")
        wait_for(sweeps.folder / "hangs", sweep.process)
        sweep.process.send_signal(number)
        told[number.name] = sweep.end()
        sweeps.leave_nothing_running()
        (sweeps.folder / "hangs").unlink()
    return sweeps, told


def wait_for(file: Path, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 60
    while not file.exists():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)


def test_each_fault_is_its_cell_s_status_and_the_others_finish(built: tuple[Any, Ended]) -> None:
    sweeps, (code, _, err) = built
    assert code == 1, err
    found = sweeps.cells()
    assert status(found[0])["state"] == "done"
    reasons = {
        1: "RuntimeError: this cell raises",
        2: "its process was ended by SIGKILL",
        3: "its process was ended by SIGSEGV",
    }
    for seed, reason in reasons.items():
        assert status(found[seed])["state"] == "failed"
        assert reason in status(found[seed])["reason"]
        assert reason in (found[seed] / "error.txt").read_text()
        assert (found[seed] / "log.txt").is_file()
        assert reason in err
    assert "Traceback" in (found[1] / "log.txt").read_text()
    assert "Segmentation fault" in (found[3] / "log.txt").read_text()
    assert not list((sweeps.folder / "s" / "locks").iterdir())


def test_a_cell_that_hangs_is_ended_at_its_limit_and_fail_fast_starts_nothing_more(
    sweeps: Any,
) -> None:
    before = content(sweeps.cells()[2])
    code, _, err = sweeps.run(*SMOKE, "seed=2,4,7", "limits.minutes=0.1", "fail_fast=true")
    assert code == 1
    assert (sweeps.folder / "hangs").exists()
    assert "limits.minutes=0.1" in status(sweeps.cells()[4])["reason"]
    assert "limits.minutes=0.1" in err
    assert err.count("training cell") == 1
    assert 7 not in sweeps.cells()
    # What had failed is left as it was, for nobody has asked for another try.
    assert content(sweeps.cells()[2]) == before
    assert "retry=failed" in err
    assert "SIGKILL" in err


def test_a_signal_ends_the_sweep_with_its_cell_and_says_how_to_go_on(
    stopped: tuple[Any, dict[str, Ended]],
) -> None:
    ended, _, err = stopped[1]["SIGINT"]
    assert ended == 130
    hint = "Finished cells are kept: run the same command again to continue."
    assert err.splitlines()[-1] == f"stopped by SIGINT. {hint}"
    assert "Traceback" not in err


def test_a_killed_sweep_is_taken_over_and_two_at_once_train_each_cell_once(
    stopped: tuple[Any, dict[str, Ended]],
) -> None:
    sweeps, told = stopped
    assert told["SIGKILL"][0] == -signal.SIGKILL
    assert [file.name for file in (sweeps.folder / "s" / "locks").iterdir()] == [
        f"{sweeps.cells()[4].name}.0"
    ]
    before = content(sweeps.cells()[0])
    arguments = (*SMOKE, "seed=4,5,0")
    (sweeps.folder / "healed").touch()
    both = [sweeps.start(*arguments) for _ in range(2)]
    printed = [sweep.end() for sweep in both]
    sweeps.leave_nothing_running()
    assert [code for code, *_ in printed] == [0, 0], printed
    assert sum(err.count("training cell") for *_, err in printed) == 2
    assert any("unfinished" in err for *_, err in printed)
    (table, other) = (out for _, out, _ in printed)
    assert table == other
    assert "failed" not in table
    assert all(status(sweeps.cells()[seed])["state"] == "done" for seed in (4, 5))
    assert content(sweeps.cells()[0]) == before
    assert not list((sweeps.folder / "s" / "locks").iterdir())


#: In a mount namespace of its own: the store moves to a small disk, which has hardly any room, and
#: then can't be written.
_SMALL_DISK = """
import os, shutil, subprocess, sys

def call(title, *arguments):
    command = [sys.executable, "-c", "from xrgs.cli.sweep import main; main()", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    print(title, done.returncode, done.stderr.replace("\\n", " "), flush=True)

def mount(options):
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", "s"], check=True)

shutil.move("s", "before")
os.mkdir("s")
mount("size=64m")
shutil.copytree("before", "s", dirs_exist_ok=True)
disk = os.statvfs("s")
with open("s/filler", "wb") as filler:
    filler.write(bytes(disk.f_bavail * disk.f_frsize - 1024 * 40))
call("tight", *sys.argv[1:], "seed=8,9,0")
mount("remount,ro")
call("read-only", *sys.argv[1:], "seed=8,9,0")
shutil.copytree("s", "after", ignore=shutil.ignore_patterns("filler"))
"""


def test_a_disk_that_takes_no_more_is_said_and_loses_nothing(sweeps: Any) -> None:
    own = ["unshare", "--map-root-user", "--mount"]
    probe = [*own, "mount", "-t", "tmpfs", "tmpfs", str(sweeps.folder)]
    if shutil.which("unshare") is None or subprocess.run(probe, check=False).returncode:
        pytest.skip("this system lets nobody mount a small disk")
    (sweeps.folder / "sitecustomize.py").write_text(FAULTS)
    done = subprocess.run(
        [*own, sys.executable, "-c", _SMALL_DISK, *SMOKE, "threads=1", "store=s"],
        cwd=sweeps.folder,
        env=os.environ | {"PYTHONPATH": str(sweeps.folder), "SWEEPS_OF": str(sweeps.folder)},
        capture_output=True,
        text=True,
        check=True,
    )
    told = {line.split()[0]: line.split(maxsplit=2)[1:] for line in done.stdout.splitlines()}
    for title, why in (
        ("tight", "No space left on device"),
        ("read-only", "Read-only file system"),
    ):
        code, err = told[title]
        assert code == "1", done.stdout
        assert why in err
        assert "store=s" in err
        assert "Traceback" not in err
        assert "Finished cells are kept" in err or "choose another with store=" in err
    before, after = (Store(sweeps.folder / name).cell_folders() for name in ("before", "after"))
    states = {cell.id: cell.state().name for cell in after}
    for cell in before:
        assert states.pop(cell.id) == cell.state().name
    assert set(states.values()) <= {"planned", "unfinished"}  # those are trained again
