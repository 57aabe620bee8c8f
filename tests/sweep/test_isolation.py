"""Tests of cells that are killed, crash or hang, and of disks that are full, with real children.

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
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from xrgs.store.store import Store

pytestmark = pytest.mark.slow

Sweep = Callable[..., tuple[int, str, str]]
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

    def hangs(_):
        child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
        Path(os.environ["SWEEPS_OF"], "hangs").touch()
        time.sleep(600)

    def run_cell(conf, variant, folder, stop):
        faults = {
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


@pytest.fixture
def sweep(faulty: Callable[[str], Sweep]) -> Sweep:
    """(*overrides) -> the end of a sweep in this process, whose children have these faults."""
    return partial(faulty(FAULTS), "train.steps=4", "threads=1")


@pytest.fixture
def sweeps(sweep: Sweep, sweeps_in: Callable[..., Any], tmp_path: Path) -> Any:
    """Sweeps in processes of their own, on the same store."""
    return sweeps_in(tmp_path, FAULTS)


def test_each_fault_is_its_cell_s_status_and_the_others_finish(sweep: Sweep, sweeps: Any) -> None:
    code, _, err = sweep("seed=2,3,0")
    assert code == 1, err
    found = sweeps.cells()
    assert status(found[0])["state"] == "done"
    for seed, name in ((2, "SIGKILL"), (3, "SIGSEGV")):
        reason = f"its process was ended by {name}"
        assert status(found[seed])["state"] == "failed"
        assert reason in status(found[seed])["reason"]
        assert reason in (found[seed] / "error.txt").read_text()
        assert (found[seed] / "log.txt").is_file()
        assert reason in err
    assert "Segmentation fault" in (found[3] / "log.txt").read_text()
    assert not list((sweeps.folder / "s" / "locks").iterdir())


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not what():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_a_sweep_waits_for_the_cell_of_another_and_takes_it_over_when_ctrl_c_has_ended_that(
    sweep: Sweep, sweeps: Any
) -> None:
    other = sweeps.start(*SMOKE, "seed=4")
    wait_for(lambda: (sweeps.folder / "hangs").exists() or other.process.poll() is not None)
    (sweeps.folder / "healed").touch()

    def stop() -> None:
        wait_for(lambda: 5 in (found := sweeps.cells()) and (found[5] / "status.json").exists())
        other.process.send_signal(signal.SIGINT)

    stopping = threading.Thread(target=stop)
    stopping.start()
    code, _, err = sweep("seed=4,5")
    stopping.join()
    assert code == 0, err
    assert "plan: 2 cells, 0 done" in err
    assert "  running " in err
    assert err.count("training cell") == 2  # of seed 5, and then of seed 4
    assert all(status(sweeps.cells()[seed])["state"] == "done" for seed in (4, 5))
    assert not list((sweeps.folder / "s" / "locks").iterdir())
    code, _, err = other.end()
    sweeps.leave_nothing_running()  # its child, and that one's child, have ended too
    assert code == 130
    hint = "Finished cells are kept: run the same command again to continue."
    assert err.splitlines()[-1] == f"stopped by SIGINT. {hint}"
    assert "Traceback" not in err


#: In a mount namespace of its own: the store moves to a small disk, which has hardly any room.
_SMALL_DISK = """
import os, shutil, subprocess, sys
from xrgs.cli.sweep import main

shutil.move("s", "before")
os.mkdir("s")
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", "s"], check=True)
shutil.copytree("before", "s", dirs_exist_ok=True)
disk = os.statvfs("s")
with open("s/filler", "wb") as filler:
    filler.write(bytes(disk.f_bavail * disk.f_frsize - 1024 * 40))
try:
    main()
finally:
    shutil.copytree("s", "after", ignore=shutil.ignore_patterns("filler"))
"""


def test_a_disk_that_is_full_is_said_and_loses_nothing(
    sweeps: Any, swept: tuple[Path, str]
) -> None:
    shutil.copytree(swept[0] / "s" / "cells", sweeps.folder / "s" / "cells")
    own = ["unshare", "--map-root-user", "--mount"]
    probe = [*own, "mount", "-t", "tmpfs", "tmpfs", str(sweeps.folder)]
    if shutil.which("unshare") is None or subprocess.run(probe, check=False).returncode:
        pytest.skip("this system lets nobody mount a small disk")
    done = subprocess.run(
        [*own, sys.executable, "-c", _SMALL_DISK, *SMOKE, "threads=1", "store=s", "seed=8,9"],
        cwd=sweeps.folder,
        env=os.environ
        | {"PYTHONPATH": str(sweeps.folder / "site"), "SWEEPS_OF": str(sweeps.folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert "No space left on device" in done.stderr
    assert "store=s" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Finished cells are kept" in done.stderr
    before, after = (Store(sweeps.folder / name).cell_folders() for name in ("before", "after"))
    states = {cell.id: cell.state().name for cell in after}
    assert len(before) == 2
    for cell in before:
        assert states.pop(cell.id) == cell.state().name == "done"
    assert set(states.values()) <= {"planned", "unfinished"}  # those are trained again
