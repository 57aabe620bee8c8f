"""Tests of real sweeps by way of each of Hydra's launchers that is installed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor  # type: ignore[import-untyped]

from xrgs.store.store import Store

pytestmark = pytest.mark.slow

Sweep = Callable[..., tuple[int, str, str]]
SMOKE = ("train.steps=4", "threads=0")
#: Folder of Ray's files; the paths of its sockets may have at most 107 bytes.
RAY = Path(tempfile.gettempdir(), "xrgs-ray")
#: Python loads this in every process that a sweep starts: each sees two cores. A cell trains
#: nothing, and ends when another cell has begun, unless the file `one` exists; if the file `kill`
#: exists, one then kills the launcher's worker.
SITE = """
import os, sys, time, types
from pathlib import Path

os.sched_getaffinity = lambda pid: {0, 1}
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    def run_cell(conf, variant, folder, stop):
        from xrgs.safeio.atomic import write_json
        home = Path(os.environ["SWEEPS_OF"])
        end = time.monotonic() + 90
        two = 1 if (home / "one").exists() else 2
        while len(list((home / "s" / "cells").glob("*/log.txt"))) < two:
            if time.monotonic() > end:
                os._exit(3)
            time.sleep(0.05)
        try:
            (home / "kill").unlink()
        except FileNotFoundError:
            pass
        else:
            os.kill(os.getppid(), 9)
            os._exit(3)
        summary = {"training_time_s": 1.5, "render_time_ms": 2, "gaussians": 7, "steps": 4}
        write_json(folder.path / "summary.json", summary | {"memory_bytes": 1, "evaluations": 1})
        (folder.path / "scores.csv").write_text("view,psnr\\na,20\\n")
        folder.finish(["a"], {})

    sys.modules["xrgs.store.cell"] = types.ModuleType("xrgs.store.cell")
    sys.modules["xrgs.store.cell"].run_cell = run_cell
"""


@pytest.fixture
def sweep(faulty: Callable[[str], Sweep], monkeypatch: pytest.MonkeyPatch) -> Sweep:
    """(*overrides) -> the end of a sweep in this process, which sees two cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return partial(faulty(SITE), *SMOKE)


def done(folder: Path) -> list[int]:
    """The threads of the cells that are done."""
    cells = Store(folder / "s").cell_folders()
    return [cell.config().threads for cell in cells if cell.state().name == "done"]


@pytest.mark.parametrize(
    ("launcher", "package", "settings"),
    [
        ("submitit_local", "submitit", ()),
        ("ray", "ray", (f"+hydra.launcher.ray.init={{num_cpus:2,_temp_dir:{RAY}}}",)),
    ],
)
def test_a_launcher_runs_a_cell(
    sweep: Sweep, tmp_path: Path, launcher: str, package: str, settings: tuple[str, ...]
) -> None:
    if find_spec(f"hydra_plugins.hydra_{package}_launcher") is None:
        pytest.skip(f"pip install 'xrgs[{package}]', which is large")
    (tmp_path / "one").touch()
    code, _, err = sweep("seed=0", f"hydra/launcher={launcher}", *settings)
    assert code == 0, err
    assert done(tmp_path) == [2]


def test_joblib_runs_two_cells_at_once_and_a_killed_worker_costs_nothing(
    sweep: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "2")
    (tmp_path / "kill").touch()
    try:
        code, _, err = sweep("seed=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    finally:
        get_reusable_executor().shutdown(wait=True)
    assert code == 0, err
    assert not (tmp_path / "kill").exists()
    assert "TerminatedWorkerError" in err
    assert "of its 2 cells these are not finished:" in err
    assert len(done(tmp_path)) == 2
