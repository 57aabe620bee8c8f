"""Tests of real sweeps by way of each of Hydra's launchers that is installed."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=4", "seed=0,1")
#: Folder of Ray's files; the paths of its sockets may have at most 107 bytes.
RAY = Path(tempfile.gettempdir(), "xrgs-ray")
#: Python loads this in every process of a sweep: each sees two cores, and a cell's process waits
#: until another cell has begun; if the file `kill` exists, one then kills the launcher's worker. No
#: report is made: it takes seconds, and is the same however its cells were launched.
SITE = """
import os, sys, time, types
from pathlib import Path

os.sched_getaffinity = lambda pid: {0, 1}
sys.modules["xrgs.report"] = types.ModuleType("xrgs.report")
sys.modules["xrgs.report"].build = lambda *_: types.SimpleNamespace(text="")
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    folder = Path(os.environ["SWEEPS_OF"])
    end = time.monotonic() + 90
    while len(list((folder / "s" / "cells").glob("*/log.txt"))) < 2:
        if time.monotonic() > end:
            os._exit(3)
        time.sleep(0.05)
    try:
        (folder / "kill").unlink()
    except FileNotFoundError:
        pass
    else:
        os.kill(os.getppid(), 9)
        os._exit(3)
"""


def results(folder: Path) -> dict[str, list[bytes]]:
    """Return what must be the same however a cell was launched, by its id."""
    names = ("scores.csv", "splats.ply", "identity.json")
    done = sorted((folder / "s" / "cells").glob("*/status.json"))
    return {file.parent.name: [(file.parent / n).read_bytes() for n in names] for file in done}


@pytest.fixture(scope="module")
def basic(
    tmp_path_factory: pytest.TempPathFactory,
    forked_command: Callable[..., tuple[int, str, str]],
    smoke_variants: Path,
) -> Path:
    """A folder whose store `s` holds the cells that the basic launcher trained."""
    folder = tmp_path_factory.mktemp("basic")
    shutil.copytree(smoke_variants, folder / "s" / "variants")
    code, _, err = forked_command("sweep", folder, *SMOKE, "store=s", "threads=1")
    assert code == 0, err
    return folder


@pytest.fixture
def folder(smoke_variants: Path, tmp_path: Path) -> Path:
    """A folder whose store `s` holds the variant and no cell."""
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    return tmp_path


@pytest.mark.parametrize(
    ("launcher", "package", "settings"),
    [
        ("submitit_local", "submitit", ()),
        ("ray", "ray", (f"+hydra.launcher.ray.init={{num_cpus:2,_temp_dir:{RAY}}}",)),
    ],
)
def test_a_launcher_runs_two_cells_at_once_to_the_results_of_basic(
    basic: Path,
    folder: Path,
    sweeps_in: Callable[..., Any],
    launcher: str,
    package: str,
    settings: tuple[str, ...],
) -> None:
    if find_spec(f"hydra_plugins.hydra_{package}_launcher") is None:
        pytest.skip(f"pip install 'xrgs[{package}]', which is large")
    given = (f"hydra/launcher={launcher}", *settings, "threads=0")
    code, _, err = sweeps_in(folder, SITE).run(*SMOKE, *given)
    assert code == 0, err
    assert results(folder) == results(basic)
    for cell in (folder / "s" / "cells").iterdir():
        assert json.loads((cell / "provenance.json").read_text())["threads"] == 1


def test_joblib_runs_two_cells_at_once_and_a_killed_worker_costs_nothing(
    basic: Path, folder: Path, sweeps_in: Callable[..., Any]
) -> None:
    (folder / "kill").touch()
    two = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "threads=0")
    code, _, err = sweeps_in(folder, SITE).run(*SMOKE, *two)
    assert code == 0, err
    assert not (folder / "kill").exists()
    assert "TerminatedWorkerError" in err
    assert "of its 2 cells these are not finished:" in err
    # Both begin and both begin again; the pool may break before the second has begun.
    assert err.count("training cell") in (3, 4)
    assert results(folder) == results(basic)


def test_a_launcher_that_is_not_installed_is_named_with_its_extra(
    tmp_path: Path, sweeps_in: Callable[..., Any]
) -> None:
    if find_spec("hydra_plugins.hydra_ray_launcher") is not None:
        pytest.skip("ray is installed")
    ray = ("hydra/launcher=ray", "hydra.launcher.ray.remote.num_cpus=2")
    code, _, err = sweeps_in(tmp_path).run(*ray, "dry_run=true")
    assert code == 1
    assert "pip install 'xrgs[ray]'" in err
