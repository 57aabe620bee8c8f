"""Tests of the launches of cells: capacities, broken launchers and what a job is given."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf

from tests.sweep.conftest import finish, hydra_config, planned
from xrgs import config
from xrgs.cli.overrides import with_quotes
from xrgs.errors import XrgsError
from xrgs.runtime import lease
from xrgs.store.attempts import begin_attempt
from xrgs.store.identity import cell_id, cell_identity
from xrgs.store.store import Store
from xrgs.sweep import study
from xrgs.sweep.job import INTERRUPTED, SweepSession
from xrgs.sweep.launchers import capacity, check, one_cell_a_gpu
from xrgs.sweep.study import LOST, Launches


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "threads", "at_once", "cores"),
    [
        (["hydra/launcher=basic"], 0, 1, 8),
        (["hydra/launcher=basic"], 3, 1, 3),
        (["hydra/launcher=joblib"], 4, 2, 4),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], 0, 2, 4),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=-3"], 0, 6, 1),
        (["hydra/launcher=joblib", "hydra.launcher.n_jobs=99"], 0, 99, 1),
        (["hydra/launcher=submitit_local"], 3, 2, 3),
        (["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=16"], 0, 1, 16),
        (["hydra/launcher=submitit_slurm"], 0, None, 1),
        (["hydra/launcher=submitit_slurm"], 4, None, 4),
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
    launcher = composed("hydra/launcher=joblib").hydra.launcher
    allowed = capacity(launcher, 0, machine=8)
    assert (allowed.at_once, allowed.threads(1000, machine=8)) == (8, 1)
    assert allowed.threads(1, machine=8) == 8
    assert allowed.threads(3, machine=8) == 2
    none = composed("hydra/launcher=joblib", "hydra.launcher.n_jobs=0").hydra.launcher
    with pytest.raises(XrgsError, match="n_jobs=0"):
        capacity(none, 0, machine=8)


def test_a_launcher_that_is_not_installed_is_named_with_its_extra(
    composed: Callable[..., DictConfig],
) -> None:
    if find_spec("hydra_plugins.hydra_ray_launcher") is not None:
        pytest.skip("ray is installed")
    given = composed("hydra/launcher=ray", "hydra.launcher.ray.remote.num_cpus=2")
    with pytest.raises(XrgsError, match=r"ray is not installed: pip install 'xrgs\[ray\]'"):
        check(given)


def test_a_ray_cluster_that_runs_already_is_given_no_size(monkeypatch: pytest.MonkeyPatch) -> None:
    def settings(address: str | None) -> Mapping[str, Any]:
        ray = {"init": {"address": address}, "remote": {}}
        launcher = OmegaConf.create({"_target_": "hydra_plugins.x.RayLauncher", "ray": ray})
        allowed = capacity(launcher, 2, machine=8)
        gpu = {"ray.remote.num_gpus": 1}
        assert one_cell_a_gpu(launcher, allowed, 0).settings == {**allowed.settings, **gpu}
        return allowed.settings

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert settings(None) == {"ray.remote.num_cpus": 2}
    # Ray refuses a cluster's address together with a size, which the launcher would fill in.
    joined = {"ray.remote.num_cpus": 2, "ray.init.object_store_memory": None}
    assert settings("auto") == joined
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    assert settings(None) == joined


@pytest.mark.parametrize(
    ("arguments", "gpus", "at_once", "cores", "settings"),
    [
        (["hydra/launcher=basic"], 4, 1, 8, {}),
        (["hydra/launcher=joblib"], 4, 4, 2, {"n_jobs": 4, "batch_size": 1}),
        (
            ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
            *(4, 2, 4, {"n_jobs": 2, "batch_size": 1}),
        ),
        (["hydra/launcher=submitit_local"], 2, 2, 4, {}),
        (["hydra/launcher=submitit_slurm"], 0, None, 1, {"cpus_per_task": 1, "gres": "gpu:1"}),
        (
            ["hydra/launcher=submitit_slurm", "hydra.launcher.gpus_per_node=1"],
            *(0, None, 1, {"cpus_per_task": 1}),
        ),
    ],
)
def test_each_cell_of_gsplat_has_a_gpu(
    composed: Callable[..., DictConfig],
    arguments: list[str],
    gpus: int,
    at_once: int | None,
    cores: int,
    settings: Mapping[str, Any],
) -> None:
    launcher = composed(*arguments).hydra.launcher
    allowed = one_cell_a_gpu(launcher, capacity(launcher, 0, machine=8), gpus)
    assert allowed.at_once == at_once
    assert allowed.settings == settings
    assert allowed.threads(1000, machine=8) == cores
    assert allowed.batch in {None, at_once}
    if at_once is not None:
        with pytest.raises(XrgsError, match=r"splat\.backend=gsplat: this machine has no GPU"):
            one_cell_a_gpu(launcher, capacity(launcher, 0, machine=8), 0)


@pytest.fixture
def composed(tmp_path: Path) -> Callable[..., DictConfig]:
    """(*overrides) -> a sweep's config with Hydra's own part, its store in the test's folder."""

    def compose(*overrides: str) -> DictConfig:
        made = hydra_config(*overrides)
        made.store = str(tmp_path / "s")
        return made

    return compose


class FakeLauncher:
    """A launcher that begins two jobs at a time, and breaks if one of them is a fatal one."""

    def __init__(self, store: Store, fatal: set[str]) -> None:
        self.store, self.fatal = store, fatal
        self.launches: list[list[str]] = []
        self.given: list[Sequence[str]] = []
        self.ids: dict[str, str] = {}
        """The id of each cell that was launched, by its label."""

    def configured(
        self, *, hydra_context: HydraContext, config: DictConfig, **_: object
    ) -> FakeLauncher:
        self.context, self.config = hydra_context, config
        return self

    def launch(self, jobs: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        assert first == len(self.given)
        ids = [job[0].removeprefix("cell=") for job in jobs]
        names = [job[2].removeprefix("name=").split(" / ")[1] for job in jobs]
        self.ids |= dict(zip(names, ids, strict=True))
        self.launches.append(names)
        self.given += jobs
        for start in range(0, len(names), 2):
            pair = names[start : start + 2]
            if "nothing" in self.fatal:
                raise RuntimeError("no such cluster\nand more")
            for name in pair:
                begin_attempt(self.store.cell(self.ids[name]))
            if self.fatal & set(pair):
                raise RuntimeError("a worker was killed")
            for name in pair:
                if {f"{how} {name}" for how in ("late", "raise", "ask")}.isdisjoint(self.fatal):
                    finish(self.store, self.ids[name])
        return [self.answer(name) for name in names]

    def answer(self, name: str) -> JobReturn:
        if f"ask {name}" in self.fatal:
            return JobReturn(status=JobStatus.COMPLETED, _return_value=INTERRUPTED)
        if {f"late {name}", f"mute {name}"} & self.fatal:
            return JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError("timed out"))
        if f"raise {name}" in self.fatal:
            shutil.rmtree(self.store.cell(self.ids[name]).path)
            return JobReturn(status=JobStatus.FAILED, _return_value=RuntimeError("no variant"))
        return JobReturn(status=JobStatus.COMPLETED, _return_value="done")


@pytest.fixture
def launch_cells(
    composed: Callable[..., DictConfig],
    compose: Callable[..., config.Conf],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., tuple[dict[str, str], FakeLauncher]]:
    """(labels, fatal, *overrides) -> outcomes when no cell is left to launch, and the launcher."""

    def launched(
        names: Sequence[str], fatal: set[str], *overrides: str
    ) -> tuple[dict[str, str], FakeLauncher]:
        store = Store(tmp_path / "s")
        store.prepare()
        fake = FakeLauncher(store, fatal)
        monkeypatch.setattr(Plugins, "instantiate_launcher", fake.configured)
        conf = replace(compose(), store=str(tmp_path / "s"))
        cells = [planned(replace(conf, seed=seed), name) for seed, name in enumerate(names)]
        context = HydraContext(None, None)  # type: ignore[arg-type]  # launches load no config
        launches = Launches(context, len, composed(*overrides))
        outcomes = launches.launch(cells, store)
        while lost := [cell for cell in cells if outcomes[str(cell.cell_id)] == LOST]:
            assert len(fake.launches) < 20
            outcomes |= launches.launch(lost, store)
        return {cell.spec.label: outcomes[str(cell.cell_id)] for cell in cells}, fake

    return launched


def test_what_a_broken_launcher_drops_is_launched_again(
    launch_cells: Callable[..., tuple[dict[str, str], FakeLauncher]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    outcomes, fake = launch_cells("abcdef", {"c"})
    assert outcomes == dict.fromkeys("abdef", "done") | {"c": "unfinished"}
    # What was begun with the fatal one comes again after all others, and alone.
    assert fake.launches == [list("abcdef"), list("ef"), ["c"], ["d"], ["c"]]
    err = capsys.readouterr().err
    assert "RuntimeError: a worker was killed" in err
    assert "of its 6 cells these are not finished:" in err
    assert "lost 3 times, not tried again" in err


def test_a_job_out_of_its_time_is_launched_again_and_other_ends_are_final(
    launch_cells: Callable[..., tuple[dict[str, str], FakeLauncher]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(XrgsError, match="RuntimeError: no such cluster"):
        launch_cells("ab", {"nothing"})
    outcomes, fake = launch_cells("abcde", {"late a", "raise b", "ask d", "mute e"})
    assert outcomes == {
        "a": "unfinished",
        "b": "failed",
        "c": "done",
        "d": INTERRUPTED,
        "e": "done",
    }
    assert fake.launches == [list("abcde"), ["a"], ["a"]]
    assert "its job was asked to end; the next sweep continues it" in capsys.readouterr().err


def test_submitit_has_no_more_jobs_at_a_time_than_there_are_cores(
    launch_cells: Callable[..., tuple[dict[str, str], FakeLauncher]],
    odd: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(study, "usable_cores", lambda: 4)
    local = ("hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=2")
    _, fake = launch_cells("abcde", set(), *local)
    assert fake.launches == [["a", "b"], ["c", "d"], ["e"]]
    threads = [fake.store.cell(name).config().threads for name in fake.ids.values()]
    assert threads == [2] * 5
    monkeypatch.chdir(odd)
    for name in ("out", "out-2"):  # two calls never share a folder
        _, fake = launch_cells("a", set(), "hydra.sweep.dir=out")
        assert fake.config.hydra.sweep.dir == str(odd / name)
        assert (odd / name / "sweep").is_file()


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """A folder whose name needs quoting everywhere."""
    folder = tmp_path / "an odd, 'quoted' ${name} = [ü] {x}"
    folder.mkdir()
    return folder


def test_a_job_finds_its_folders_wherever_it_runs(
    compose: Callable[..., config.Conf], odd: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = ("scene.path=p", "scene.masks=m", "variant.poses=q", "store=s")
    conf = compose("scene=folder", *folders, "seed=1", "splat.backend=auto")
    cell, store = planned(conf, "a"), Store("s")
    monkeypatch.chdir(odd)
    store.prepare()
    overrides = study._hand_over(cell, 3, store)
    monkeypatch.chdir(odd.parent)
    assert overrides == [f"cell={cell.cell_id}", f"store={odd / 's'}", f"name={cell.name}"]
    given = Store(odd / "s").cell(str(cell.cell_id))
    conf_given = given.config()
    assert (conf_given.store, conf_given.scene.path) == (str(odd / "s"), str(odd / "p"))
    given_photographs = (conf_given.scene.masks, conf_given.variant.poses)
    assert given_photographs == (str(odd / "m"), str(odd / "q"))
    assert (conf_given.seed, conf_given.threads) == (1, 3)
    assert conf_given.splat.backend in {"native", "torch"}
    assert cell_id(given.identity()) == cell.cell_id == cell_id(cell_identity(conf_given, "v"))
    assert given.state().name == "planned"
    assert conf.store == "s"  # the plan's own config is not changed


@pytest.mark.parametrize("how", ["done", "training"])
def test_a_cell_that_another_sweep_has_begun_since_the_plan_is_left_as_it_is(
    compose: Callable[..., config.Conf], store: Store, how: str
) -> None:
    ours, theirs = (planned(replace(compose(), threads=n), "a") for n in (1, 2))
    study._hand_over(theirs, 1, store)
    cell = store.cell(str(theirs.cell_id))
    begin_attempt(cell)
    if how == "done":
        finish(store, cell.id)
    else:
        assert lease.acquire(store.leases, cell.id) is not None
    assert study._hand_over(ours, 1, store)[0] == f"cell={cell.id}"
    assert cell.config().threads == 2
    assert cell.state().name == ("done" if how == "done" else "unfinished")


def test_a_launcher_composes_nothing_for_a_job(
    launch_cells: Callable[..., tuple[dict[str, str], FakeLauncher]], tmp_path: Path
) -> None:
    """A launcher asks for a job's config where the job runs, to which the loader is pickled."""
    setting = "+hydra.job.env_set.NAME=value"
    _, fake = launch_cells("ab", set(), f"hydra.sweep.dir={tmp_path / 'out'}", setting)
    assert [job[0] for job in fake.given] == [f"cell={name}" for name in fake.ids.values()]
    loader = pickle.loads(pickle.dumps(fake.context.config_loader))  # noqa: S301
    job = loader.load_sweep_config(fake.config, list(fake.given[0]))
    assert job.keys() == {"hydra", "cell", "store", "name"}
    assert job.cell == fake.ids["a"]
    assert job.hydra.sweep.dir == str(tmp_path / "out")
    assert job.hydra.job.env_set == {"NAME": "value"}
    assert job.hydra.overrides.task == [f"cell={job.cell}"]
    job.hydra.job.num = 7  # as launchers do
    assert job.hydra.sweep.subdir == "7"
    assert "cell" not in fake.config
    assert fake.config.hydra.job.get("num") != 7


def test_an_id_that_looks_like_a_number_stays_text_and_a_sweep_that_is_gone_begins_no_job(
    composed: Callable[..., DictConfig], session: SweepSession
) -> None:
    given = composed(*with_quotes([f"hydra.sweep.dir={session.folder}"]))
    for name in ("0123456789012345", "12e4567890123456"):
        job = study._JobConfigLoader().load_sweep_config(given, [f"cell={name}"])
        assert job.cell == name
    session.folder.rename(session.folder.with_name("elsewhere"))
    # Hydra would make the folder again, and the store with it.
    with pytest.raises(XrgsError, match="is no longer there"):
        study._JobConfigLoader().load_sweep_config(given, ["cell=a"])
