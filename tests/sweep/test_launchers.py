"""Tests of real sweeps by way of each of Hydra's launchers that is installed."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from xrgs.store.store import Store

pytestmark = pytest.mark.slow

SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=4", "seed=0,1", "threads=0")
#: Folder of Ray's files; the paths of its sockets may have at most 107 bytes.
RAY = Path(tempfile.gettempdir(), "xrgs-ray")
#: Python loads this in every process of a sweep: each sees two cores. A cell trains nothing, and
#: ends when another cell has begun; if the file `kill` exists, one then kills the launcher's
#: worker. No report is made.
SITE = """
import os, sys, time, types
from pathlib import Path

os.sched_getaffinity = lambda pid: {0, 1}
sys.modules["xrgs.report"] = types.ModuleType("xrgs.report")
sys.modules["xrgs.report"].build = lambda *_: types.SimpleNamespace(text="")
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    def run_cell(conf, variant, folder, stop):
        from xrgs.safeio.atomic import write_json
        home = Path(os.environ["SWEEPS_OF"])
        end = time.monotonic() + 90
        while len(list((home / "s" / "cells").glob("*/log.txt"))) < 2:
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
def folder(smoke_variants: Path, tmp_path: Path) -> Path:
    """A folder whose store `s` holds the variant and no cell."""
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    return tmp_path


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
def test_a_launcher_runs_two_cells_at_once(
    folder: Path,
    sweeps_in: Callable[..., Any],
    launcher: str,
    package: str,
    settings: tuple[str, ...],
) -> None:
    if find_spec(f"hydra_plugins.hydra_{package}_launcher") is None:
        pytest.skip(f"pip install 'xrgs[{package}]', which is large")
    code, _, err = sweeps_in(folder, SITE).run(*SMOKE, f"hydra/launcher={launcher}", *settings)
    assert code == 0, err
    assert done(folder) == [1, 1]  # of two cores


def test_joblib_runs_two_cells_at_once_and_a_killed_worker_costs_nothing(
    folder: Path, sweeps_in: Callable[..., Any]
) -> None:
    (folder / "kill").touch()
    two = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    code, _, err = sweeps_in(folder, SITE).run(*SMOKE, *two)
    assert code == 0, err
    assert not (folder / "kill").exists()
    assert "TerminatedWorkerError" in err
    assert "of its 2 cells these are not finished:" in err
    # Both begin and both begin again; the pool may break before the second has begun.
    assert err.count("training cell") in (3, 4)
    assert len(done(folder)) == 2
