"""Tests of a study: when it starts no further cell, and what it composes and computes once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import hydra
import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig

from xrgs import config
from xrgs.experiment.store import Store
from xrgs.safeio.hashing import digest
from xrgs.sweep import plan as plan_module
from xrgs.sweep import study as study_module
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.jobs.job import FAIL_FAST, STOPPED, STORE_FULL
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import PlannedCell
from xrgs.sweep.session import SweepSession
from xrgs.sweep.study import Study


class Launcher:
    """A launcher whose first job is lost, after it has perhaps stopped the others."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        self.launched = 0

    def configured(self, *, config: DictConfig, **_: object) -> Launcher:
        self.session = SweepSession(Path(config.hydra.sweep.dir))
        return self

    def launch(self, jobs: Sequence[Sequence[str]], _: int) -> list[JobReturn]:
        self.launched += len(jobs)
        if self.reason:
            self.session.stop(self.reason)
        raised = JobReturn(
            status=JobStatus.FAILED, _return_value=RuntimeError("its answer is lost")
        )
        stopped = JobReturn(status=JobStatus.COMPLETED, _return_value=STOPPED)
        return [raised, *[stopped] * (len(jobs) - 1)]


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Study]:
    """(*overrides) -> a study in the test's folder."""
    monkeypatch.chdir(tmp_path)

    def made(*overrides: str) -> Study:
        config.register()
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            composed = hydra.compose("config", list(overrides), return_hydra_config=True)
        return Study(HydraContext(None, None), len, composed)  # type: ignore[arg-type]

    return made


@pytest.mark.parametrize(
    ("reason", "fail_fast", "said"),
    [
        (STORE_FULL, False, STORE_FULL),
        (STORE_FULL, True, STORE_FULL),
        (FAIL_FAST, True, FAIL_FAST),
        ("", True, FAIL_FAST),
        ("", False, None),
    ],
)
def test_a_sweep_that_starts_nothing_more_says_why(
    compose: Callable[..., config.Conf],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reason: str,
    fail_fast: bool,
    said: str | None,
    study: Callable[..., Study],
) -> None:
    store, launcher = Store(Path("s")), Launcher(reason)
    store.prepare()
    monkeypatch.setattr(Plugins, "instantiate_launcher", launcher.configured)
    given = ("store=s", f"fail_fast={fail_fast}")
    plan = [
        PlannedCell(CellSpec(name, "", (f"x={name}",), ()), compose(*given), "v", {"x": name})
        for name in "abc"
    ]
    plan = [replace(cell, cell_id=digest(cell.identity)) for cell in plan]
    with SweepMonitor(store.cells_folder) as monitor:
        final = study(*given)._run_until_complete(plan, store, monitor)
    assert [cell.state.name for cell in final] == ["absent"] * 3
    assert launcher.launched == 3
    lines = [line for line in capsys.readouterr().err.splitlines() if "no further cell" in line]
    assert lines == ([f"no further cell is started: {said}"] if said else [])


class ConfigLoader:
    """Composes as Hydra's loader does, and counts."""

    def __init__(self) -> None:
        self.composed: list[list[str]] = []

    def load_sweep_config(self, _: DictConfig, overrides: list[str]) -> DictConfig:
        self.composed.append(overrides)
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            return hydra.compose("config", overrides, return_hydra_config=True)


def test_seeds_share_one_composed_config_and_each_cell_is_identified_once(
    study: Callable[..., Study], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, loader = study(), ConfigLoader()
    made._context = HydraContext(loader, None)  # type: ignore[arg-type]  # all that a study calls
    seeds = [0, 1, 2]
    plan = made._plan(["+ablation=consistency", f"seed={','.join(map(str, seeds))}"])
    assert [cell.conf.seed for cell in plan] == [0, 0, 1, 1, 2, 2]
    assert len(loader.composed) == 2
    store = Store(tmp_path / "s")
    store.prepare()
    plan = made._identified([replace(cell, variant_id="v") for cell in plan], store)
    assert len({cell.cell_id for cell in plan}) == 6
    assert all(cell.cell_id == digest(cell.identity) for cell in plan)

    def unexpected(*_: object) -> None:
        raise AssertionError("an identity is computed once")

    monkeypatch.setattr(plan_module, "cell_identity", unexpected)
    assert made._identified(plan, store) == plan


def test_a_seed_that_other_values_depend_on_is_composed_for_each(
    study: Callable[..., Study],
) -> None:
    made, loader = study(), ConfigLoader()
    made._context = HydraContext(loader, None)  # type: ignore[arg-type]  # all that a study calls
    plan = made._plan(["seed=3,4", "variant.seed=${seed}"])
    assert [cell.conf.variant.seed for cell in plan] == [3, 4]


def test_a_cell_that_waits_for_a_count_in_vain_says_so(compose: Callable[..., config.Conf]) -> None:
    control = ("+ablation=count_matched", "matched_to=gradient_scaling")
    cell = PlannedCell(CellSpec("count_matched", "", (), control), compose(*control))
    assert cell.waits
    error = study_module._without_reference(cell).error
    assert error == "matched_to=gradient_scaling: that cell is not done"
