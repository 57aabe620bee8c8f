"""Cells by way of Hydra's launchers: real sweeps, and launchers that break."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf

from xrgs import config
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json
from xrgs.sweep import launch
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.launch import LOST, Launches, capacity
from xrgs.sweep.plan import PlannedCell

SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=4", "seed=0,1")
#: Ray's files: the names of its sockets may have no more than 107 bytes.
RAY = Path(tempfile.gettempdir(), "xrgs-ray")
#: Python loads it in every process of a sweep: each sees two cores, and a cell's process waits for
#: another cell to have begun; one of them then kills the launcher's worker where that is asked for.
SITE = """
import os, sys, time
from pathlib import Path

os.sched_getaffinity = lambda pid: {0, 1}
if "xrgs.sweep.jobs.worker" in sys.orig_argv and "cell" in sys.orig_argv:
    folder = Path(os.environ["SWEEPS_OF"])
    end = time.monotonic() + 90
    while len(list((folder / "s" / "cells").glob("*/identity.json"))) < 2:
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
    """What must be the same however a cell was run, by its id."""
    names = ("scores.csv", "splats.ply", "identity.json")
    done = sorted((folder / "s" / "cells").glob("*/status.json"))
    return {file.parent.name: [(file.parent / n).read_bytes() for n in names] for file in done}


@pytest.fixture(scope="module")
def basic(tmp_path_factory: pytest.TempPathFactory, sweeps_in: Callable[..., Any]) -> Path:
    """A folder whose store `s` holds the cells as the basic launcher runs them."""
    folder = tmp_path_factory.mktemp("basic")
    code, _, err = sweeps_in(folder).run(*SMOKE)
    assert code == 0, err
    return folder


@pytest.fixture
def folder(basic: Path, tmp_path: Path) -> Path:
    """A folder with its variant, and no cell."""
    shutil.copytree(basic / "s" / "variants", tmp_path / "s" / "variants")
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
    assert "of its 2 cells are left:" in err
    assert err.count("training cell") == 4
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


def test_a_launcher_named_in_an_ablation_is_refused(
    tmp_path: Path, sweeps_in: Callable[..., Any]
) -> None:
    (tmp_path / "mine" / "ablation").mkdir(parents=True)
    for name in ("here", "there"):
        file = tmp_path / "mine" / "ablation" / f"{name}.yaml"
        file.write_text("# @package _global_\ndefaults:\n  - override /hydra/launcher: joblib\n")
    mine = ("dry_run=true", "--config-dir", "mine")
    code, _, err = sweeps_in(tmp_path).run("+ablation=here,there", *mine)
    assert code == 1
    assert "a launcher is chosen once for a sweep" in err


@pytest.mark.parametrize(
    ("arguments", "threads", "at_once", "cores"),
    [
        (["hydra/launcher=basic"], 0, 1, 8),
        (["hydra/launcher=basic"], 3, 1, 3),
        (["hydra/launcher=joblib"], 0, 8, 1),
        (["hydra/launcher=joblib"], 4, 2, 4),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], 0, 2, 4),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=-3"], 0, 6, 1),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=99"], 0, 99, 1),
        (["hydra/launcher=submitit_local"], 0, 8, 1),
        (["hydra/launcher=submitit_local"], 3, 2, 3),
        (["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=4"], 0, 2, 4),
        (["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=16"], 0, 1, 16),
        (["hydra/launcher=submitit_slurm"], 0, None, 1),
        (["hydra/launcher=submitit_slurm"], 4, None, 4),
        (["hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=2"], 0, None, 2),
    ],
)
def test_cores_are_divided_among_the_cells_that_run_at_once(
    composed: Callable[..., DictConfig],
    arguments: list[str],
    threads: int,
    at_once: int | None,
    cores: int,
) -> None:
    allowed = capacity(composed(*arguments).hydra.launcher, threads, machine=8)
    assert allowed.at_once == at_once
    assert allowed.threads(1000, machine=8) == cores


def test_a_last_cell_has_the_machine_to_itself(composed: Callable[..., DictConfig]) -> None:
    allowed = capacity(composed("hydra/launcher=joblib").hydra.launcher, 0, machine=8)
    assert allowed.threads(1, machine=8) == 8
    assert allowed.threads(3, machine=8) == 2


def test_no_jobs_at_all_are_refused(composed: Callable[..., DictConfig]) -> None:
    launcher = composed("hydra/launcher=joblib", "hydra.launcher.n_jobs=0").hydra.launcher
    with pytest.raises(XrgsError, match="n_jobs=0"):
        capacity(launcher, 0, machine=8)


@pytest.fixture
def composed(tmp_path: Path) -> Callable[..., DictConfig]:
    """(*overrides) -> a sweep's config with Hydra's own part, its store in the test's folder."""

    def compose(*overrides: str) -> DictConfig:
        config.register()
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            store = f"store={launch._quoted(tmp_path / 's')}"
            return hydra.compose("config", [store, *overrides], return_hydra_config=True)

    return compose


class Fake:
    """A launcher that begins two jobs at a time, and breaks where one of them is a fatal one."""

    def __init__(self, store: Store, fatal: set[str]) -> None:
        self.store, self.fatal = store, fatal
        self.launches: list[list[str]] = []
        self.given: list[Sequence[str]] = []

    def configured(self, *, config: DictConfig, **_: object) -> Fake:
        self.config = config
        return self

    def launch(self, jobs: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        assert first == len(self.given)
        names = [job[0].partition("=")[2] for job in jobs]
        self.launches.append(names)
        self.given += jobs
        for start in range(0, len(names), 2):
            pair = names[start : start + 2]
            if "nothing" in self.fatal:
                raise RuntimeError("no such cluster\nand more")
            for name in pair:
                self.store.cell(name).begin({}, {})
            if self.fatal & set(pair):
                raise RuntimeError("a worker was killed")
            for name in pair:
                if {f"late {name}", f"raise {name}"}.isdisjoint(self.fatal):
                    finish(self.store, name)
        return [self.answer(name) for name in names]

    def answer(self, name: str) -> JobReturn:
        if f"late {name}" in self.fatal:
            return JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError("timed out"))
        if f"raise {name}" in self.fatal:
            shutil.rmtree(self.store.cell(name).path)
            return JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError("no variant"))
        return JobReturn(status=JobStatus.COMPLETED, _return_value="done")


def finish(store: Store, name: str) -> None:
    cell = store.cell(name)
    (cell.path / "scores.csv").write_text("view\na\n")
    write_json(cell.path / "summary.json", {})
    cell.finish(["a"], 1)


@pytest.fixture
def launch_cells(
    composed: Callable[..., DictConfig],
    compose: Callable[..., config.Conf],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., tuple[dict[str, str], Fake]]:
    """(names, fatal, *overrides) -> outcomes when nothing is left to launch, and the launcher."""

    def launched(
        names: Sequence[str], fatal: set[str], *overrides: str
    ) -> tuple[dict[str, str], Fake]:
        store = Store(tmp_path / "s")
        store.prepare()
        fake = Fake(store, fatal)
        monkeypatch.setattr(Plugins, "instantiate_launcher", fake.configured)
        conf = compose(f"store={launch._quoted(tmp_path / 's')}")
        cells = [PlannedCell(CellSpec(n, "", (f"x={n}",), ()), conf, "v", n) for n in names]
        launches = Launches(HydraContext(None, None), len, composed(*overrides))
        outcomes = launches.run(cells, store)
        while left := [cell for cell in cells if outcomes[str(cell.cell_id)] == LOST]:
            assert len(fake.launches) < 20
            outcomes |= launches.run(left, store)
        return outcomes, fake

    return launched


def test_what_a_broken_launcher_drops_is_launched_again(
    launch_cells: Callable[..., tuple[dict[str, str], Fake]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    outcomes, fake = launch_cells("abcdef", {"c"})
    assert outcomes == dict.fromkeys("abdef", "done") | {"c": "unfinished"}
    # What was begun with the fatal one comes again after all others, and alone.
    assert fake.launches == [list("abcdef"), list("ef"), ["c"], ["d"], ["c"]]
    err = capsys.readouterr().err
    assert "RuntimeError: a worker was killed" in err
    assert "of its 6 cells are left:" in err
    assert "lost 3 times, not tried again" in err


def test_a_job_out_of_its_time_is_launched_again_and_another_s_failure_is_final(
    launch_cells: Callable[..., tuple[dict[str, str], Fake]],
) -> None:
    outcomes, fake = launch_cells("abc", {"late a", "raise b"})
    assert outcomes == {"a": "unfinished", "b": "failed", "c": "done"}
    assert fake.launches == [["a", "b", "c"], ["a"], ["a"]]


def test_a_launcher_that_begins_nothing_ends_the_sweep_with_its_own_words(
    launch_cells: Callable[..., tuple[dict[str, str], Fake]],
) -> None:
    with pytest.raises(XrgsError, match="RuntimeError: no such cluster"):
        launch_cells("abc", {"nothing"})


def test_submitit_has_no_more_jobs_at_a_time_than_there_are_cores(
    launch_cells: Callable[..., tuple[dict[str, str], Fake]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(launch, "usable_cores", lambda: 4)
    local = ("hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=2")
    _, fake = launch_cells("abcde", set(), *local)
    assert fake.launches == [["a", "b"], ["c", "d"], ["e"]]
    assert all("threads=2" in job for job in fake.given)


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """A folder whose name needs quoting everywhere."""
    folder = tmp_path / "an odd, 'quoted' ${name} = [ü] {x}"
    folder.mkdir()
    return folder


def test_a_job_finds_its_folders_wherever_it_runs(
    compose: Callable[..., config.Conf], odd: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conf = compose("scene=folder", "scene.path=p", "store=s")
    cell = PlannedCell(CellSpec("a", "", ("seed=1",), ()), conf, "v", "a")
    monkeypatch.chdir(odd)
    overrides = launch._overrides(cell, threads=3)
    monkeypatch.chdir(odd.parent)
    there = compose("scene=folder", *overrides)
    assert (there.store, there.scene.path) == (str(odd / "s"), str(odd / "p"))
    assert (there.seed, there.threads) == (1, 3)
    assert there.splat.backend in {"native", "torch"}


def test_two_calls_never_share_a_folder(
    launch_cells: Callable[..., tuple[dict[str, str], Fake]],
    composed: Callable[..., DictConfig],
    odd: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(odd)
    for name in ("out", "out-2"):
        _, fake = launch_cells("a", set(), "hydra.sweep.dir=out")
        told = OmegaConf.to_container(fake.config.hydra.overrides.hydra)
        assert fake.config.hydra.sweep.dir == composed(*told).hydra.sweep.dir == str(odd / name)
        assert (odd / name / "sweep").is_file()
