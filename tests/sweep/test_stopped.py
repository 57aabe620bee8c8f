"""A sweep that starts nothing more, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import hydra
import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig

from xrgs import config
from xrgs.experiment.store import Store
from xrgs.sweep.jobs.job import FAIL_FAST, STOPPED, STORE_FULL, SweepSession
from xrgs.sweep.monitor import View
from xrgs.sweep.plan import CellSpec, Planned
from xrgs.sweep.study import Study


class Launcher:
    """One whose first job is lost, after it has perhaps stopped the others."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        self.launched = 0

    def configured(self, *, config: DictConfig, **_: object) -> Launcher:
        self.call = SweepSession(Path(config.hydra.sweep.dir))
        return self

    def launch(self, jobs: Sequence[Sequence[str]], _: int) -> list[JobReturn]:
        self.launched += len(jobs)
        if self.reason:
            self.call.stop(self.reason)
        raised = JobReturn(
            status=JobStatus.FAILED, _return_value=RuntimeError("its answer is lost")
        )
        stopped = JobReturn(status=JobStatus.COMPLETED, _return_value=STOPPED)
        return [raised, *[stopped] * (len(jobs) - 1)]


@pytest.mark.parametrize(
    ("reason", "fail_fast", "told"),
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
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    reason: str,
    fail_fast: bool,
    told: str | None,
) -> None:
    monkeypatch.chdir(tmp_path)
    store, launcher = Store(Path("s")), Launcher(reason)
    store.prepare()
    monkeypatch.setattr(Plugins, "instantiate_launcher", launcher.configured)
    given = ("store=s", f"fail_fast={fail_fast}")
    plan = [
        Planned(CellSpec(name, "", (f"x={name}",), ()), compose(*given), "v", name)
        for name in "abc"
    ]
    with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
        composed = hydra.compose("config", list(given), return_hydra_config=True)
    with View(store.cells) as view:
        study = Study(HydraContext(None, None), len, composed)
        left = study._worked_off(plan, store, view)
    assert [cell.state.name for cell in left] == ["absent"] * 3
    assert launcher.launched == 3
    lines = [line for line in capsys.readouterr().err.splitlines() if "nothing more" in line]
    assert lines == ([f"nothing more is started: {told}"] if told else [])
