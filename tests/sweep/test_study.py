"""Tests of a study: when it starts no further cell, and what it composes and computes once."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import CompactHydraException
from omegaconf import DictConfig

from tests.conftest import composed_by_hydra
from tests.sweep.conftest import content, finish, planned
from xrgs import config
from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import download, weights
from xrgs.photos import scenes
from xrgs.store.attempts import begin_attempt
from xrgs.store.identity import cell_id
from xrgs.store.store import BASELINE, Store
from xrgs.sweep import build_variants
from xrgs.sweep import plan as plan_module
from xrgs.sweep import study as study_module
from xrgs.sweep.job import FAIL_FAST, STOPPED, STORE_FULL, SweepSession
from xrgs.sweep.monitor import SweepMonitor
from xrgs.sweep.plan import PlannedCell, describe, record
from xrgs.sweep.study import Study, provide_lpips


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reason", "fail_fast", "said"),
    [(STORE_FULL, True, STORE_FULL), ("", True, FAIL_FAST), ("", False, None)],
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
    conf = replace(compose("store=s"), fail_fast=fail_fast)
    plan = [planned(replace(conf, seed=seed), BASELINE, f"seed={seed}") for seed in range(3)]
    with SweepMonitor(store.cells_folder) as monitor:
        final = study("store=s")._run_until_complete(plan, store, [monitor])
    assert [cell.state.name for cell in final] == ["planned"] * 3
    assert launcher.launched == 3
    lines = [line for line in capsys.readouterr().err.splitlines() if "no further cell" in line]
    assert lines == ([f"no further cell is started: {said}"] if said else [])


def test_seeds_share_one_composed_config_and_each_cell_is_identified_once(
    study: Callable[..., Study], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = study()
    words = ["preset=laptop", "+ablation=consistency", "seed=3,4", "variant.seed=${seed}"]
    plan = made._plan(words)
    assert [cell.conf.seed for cell in plan] == [3, 3, 4, 4]
    assert [cell.conf.variant.seed for cell in plan] == [3, 3, 4, 4]
    assert len(made._context.config_loader.composed) == 2  # type: ignore[attr-defined]
    assert [cell.name.partition(" / ")[2] for cell in plan[::2]] == [
        "baseline / variant.seed 3 / seed 3",
        "baseline / variant.seed 4 / seed 4",
    ]
    rows = record(plan)
    assert {(row.variant_seed, row.seed, row.condition) for row in rows} == {(3, 3, ""), (4, 4, "")}
    assert [cell.conf for cell in plan] == [
        composed_by_hydra(*cell.spec.overrides) for cell in plan
    ]
    others = made._plan(["seed=3,4", "variant.sfm.seed=${seed}"])
    assert [cell.conf.variant.sfm.seed for cell in others] == [3, 4]
    store = Store(tmp_path / "s")
    store.prepare()
    plan = made._identified([replace(cell, variant_id="v") for cell in plan], store)
    assert len({cell.cell_id for cell in plan}) == 4
    assert all(cell.identity and cell.cell_id == cell_id(cell.identity) for cell in plan)

    def unexpected(*_: object) -> None:
        raise AssertionError("an identity is computed once")

    monkeypatch.setattr(plan_module, "cell_identity", unexpected)
    assert made._identified(plan, store) == plan


@pytest.mark.slow
def test_cells_that_differ_in_numbers_share_one_config_and_get_their_own_values(
    study: Callable[..., Study],
) -> None:
    made = study()
    plan = made._plan(["preset=laptop", "variant.factor=2,5", "variant.hr_fraction=0.1,0.5"])
    assert [cell.conf for cell in plan] == [
        composed_by_hydra(*cell.spec.overrides) for cell in plan
    ]
    assert len(plan) == 4
    assert len(made._context.config_loader.composed) == 1  # type: ignore[attr-defined]
    with pytest.raises(XrgsError, match=r"^variant.factor=0: "):
        made._plan(["variant.factor=2,0"])
    with pytest.raises(XrgsError, match=r"pa/room and .*pb/room: both are called room"):
        made._plan(["scene=folder", "scene.path=/pa/room,/pb/room"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fixed", "conditions"),
    [
        ("train.validation=0.1", {"train.validation=0.1"}),
        ("train.validation=0,0.1", {"train.validation=0", "train.validation=0.1"}),
    ],
)
def test_a_condition_says_where_scores_are_of_held_out_training_views(
    study: Callable[..., Study], fixed: str, conditions: set[str]
) -> None:
    made = study()
    matched = ("+ablation=count_matched", "matched_to=gradient_scaling")
    plan = made._plan([*matched, fixed])
    assert {cell.spec.condition for cell in plan} == conditions
    assert len(plan) == 3 * len(conditions), "baseline, reference and matched"
    assert len({cell.spec for cell in plan}) == len(plan)
    assert all(cell.reference in {c.spec for c in plan} for cell in plan if cell.reference)


@pytest.mark.parametrize(
    ("fixed", "conditions"),
    [
        (["variant.test_every=0"], {"scored on the training views"}),
        (["variant.test_every=0", "variant.test=[a,b]"], {""}),
        (
            ["variant.test_every=0,8"],
            {"variant.test_every=0 scored on the training views", "variant.test_every=8"},
        ),
    ],
)
def test_a_condition_says_where_scores_are_of_the_training_views(
    study: Callable[..., Study], fixed: list[str], conditions: set[str]
) -> None:
    plan = study()._plan(fixed)
    assert {cell.spec.condition for cell in plan} == conditions
    assert {row.condition for row in record(plan)} == conditions


def train(store: Store, name: str) -> None:
    store.cell(name).path.mkdir(exist_ok=True)
    begin_attempt(store.cell(name))
    finish(store, name)


class Trainer:
    """A launcher whose jobs finish their cells."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.launched: list[str] = []

    def configured(self, **_: object) -> Trainer:
        return self

    def launch(self, jobs: Sequence[Sequence[str]], _: int) -> list[JobReturn]:
        for job in (overrides[0] for overrides in jobs):
            self.launched.append(job.removeprefix("cell="))
            train(self.store, self.launched[-1])
        return [JobReturn(status=JobStatus.COMPLETED, _return_value="done") for _ in jobs]


@pytest.fixture
def two_planned(
    compose: Callable[..., config.Conf], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> tuple[Store, Trainer, list[PlannedCell]]:
    """A store in which the first of two cells is done, a launcher, and the plan of both."""
    store = Store(tmp_path / "s")
    store.prepare()
    trainer = Trainer(store)
    monkeypatch.setattr(Plugins, "instantiate_launcher", trainer.configured)
    monkeypatch.setattr(study_module, "_POLL_S", 0.0)
    conf = compose("store=s", "splat.backend=torch")
    plan = [planned(replace(conf, seed=seed), BASELINE, f"seed={seed}") for seed in (0, 1)]
    train(store, str(plan[0].cell_id))
    return store, trainer, plan


def test_a_cell_that_can_not_be_read_fails_and_the_others_are_trained(
    two_planned: tuple[Store, Trainer, list[PlannedCell]],
    study: Callable[..., Study],
    unreadable: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    store, trainer, plan = two_planned
    before = content(store.cell(str(plan[0].cell_id)).path)
    unreadable(f"{plan[0].cell_id}/status.json", errno.EIO)
    with SweepMonitor(store.cells_folder) as monitor:
        made = study("store=s")
        plan = made._identified(plan, store)
        final = made._run_until_complete(plan, store, [monitor])
    assert trainer.launched == [plan[1].cell_id]
    assert [cell.state.name for cell in final] == ["failed", "done"]
    text = describe(final)
    assert f"{plan[0].cell_id}/status.json: {os.strerror(errno.EIO)}" in text
    assert "retry=failed" in text
    assert [row.error for row in record(final)] == [None, None]
    unreadable("", 0)
    assert content(store.cell(str(plan[0].cell_id)).path) == before
    assert "1 of 2 cells done, 1 failed" in capsys.readouterr().err


def test_the_notes_of_a_variant_are_given_once_for_all_of_its_cells(
    two_planned: tuple[Store, Trainer, list[PlannedCell]], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, _, plan = two_planned
    found = build_variants.PlannedVariant("v", notes=("icon.png left out", "not placed: IMG_1"))
    monkeypatch.setattr(build_variants, "plan", lambda confs, *_, **__: [found] * len(confs))
    _, notes = plan_module.with_variants(plan, store, allow_build=True)
    scene = scenes.label(plan[0].conf.scene)
    assert notes == [f"{scene}: icon.png left out", f"{scene}: not placed: IMG_1"]


def test_a_count_that_can_not_be_read_fails_the_cell(
    two_planned: tuple[Store, Trainer, list[PlannedCell]],
    study: Callable[..., Study],
    unreadable: Callable[..., None],
    compose: Callable[..., config.Conf],
) -> None:
    store, _, (reference, _) = two_planned
    control = ("+ablation=count_matched", f"matched_to={BASELINE}")
    cell = PlannedCell(reference.spec, compose(*control), "v")
    assert cell.reference is not None
    done = replace(reference, state=store.cell(str(reference.cell_id)).state())
    unreadable("summary.json", errno.EIO)
    waiting = study("store=s")._with_count(cell, {cell.reference: done}, store)
    assert "summary.json" in str(waiting.error)
    assert waiting.conf == cell.conf
    in_vain = study_module._without_reference(cell)
    assert in_vain.error == f"matched_to={BASELINE}: that cell is not done"


@pytest.mark.parametrize("how", ["deleted", "unmounted"])
def test_a_store_that_vanishes_ends_the_study_with_one_line(
    two_planned: tuple[Store, Trainer, list[PlannedCell]],
    study: Callable[..., Study],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    how: str,
) -> None:
    store, trainer, plan = two_planned

    def launch(jobs: Sequence[Sequence[str]], _: int) -> list[JobReturn]:
        store.path.rename(tmp_path / "moved")
        if how == "deleted":
            shutil.rmtree(tmp_path / "moved")
        elif how == "unmounted":
            store.path.mkdir()
        raise RuntimeError("a worker found no folder")

    monkeypatch.setattr(trainer, "launch", launch)
    made = study("store=s")

    def train(_: object) -> bool:
        made._store = store
        with SweepMonitor(store.cells_folder) as monitor:
            made._run_until_complete(made._identified(plan, store), store, [monitor])
        return True

    monkeypatch.setattr(made, "_plan_and_train", train)
    with pytest.raises(CompactHydraException, match=r"^store=.*: it is no longer there") as end:
        made.run([])
    assert "\n" not in str(end.value)
    assert capsys.readouterr().err == ""
    if how == "unmounted":
        store.path.rmdir()  # empty
    assert not store.path.exists()


def test_an_error_of_the_store_has_no_traceback(
    study: Callable[..., Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = study("store=s")

    def fail(_: object) -> bool:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), "s/sweeps/a.json")

    monkeypatch.setattr(made, "_plan_and_train", fail)
    with pytest.raises(CompactHydraException, match=r"store=s: .*a\.json.*same command again"):
        made.run([])


def test_values_that_no_cell_can_have_are_refused(compose: Callable[..., config.Conf]) -> None:
    for override in ("seed=-1", "variant.seed=-1", "train.views=foo"):
        with pytest.raises(XrgsError, match=override):
            compose(override)
    conf = compose()
    refused: dict[str, dict[str, Any]] = {
        "variant.factor=0: must be 1 or more": {"factor": 0},
        "variant.sfm.camera=two": {"sfm": replace(conf.variant.sfm, camera="two")},
        "variant.long_side=54: must be 0 .* or at least 55": {"long_side": 54},
    }
    for message, changes in refused.items():
        with pytest.raises(XrgsError, match=message):
            plan_module.check_sizes(replace(conf, variant=replace(conf.variant, **changes)))
    fits: list[dict[str, Any]] = [
        {"long_side": 0},
        {"long_side": 55},
        {"long_side": 22, "factor": 2},
    ]
    for allowed in fits:
        plan_module.check_sizes(replace(conf, variant=replace(conf.variant, **allowed)))


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Stands in for the download; the arguments of each are kept."""
    calls: list[dict[str, Any]] = []

    def fetch(**given: Any) -> str:
        calls.append(given)
        return "LPIPS: fetched"

    monkeypatch.setattr(download, "fetch_weights", fetch)
    monkeypatch.setattr(weights, "find_weights", lambda: None)
    return calls


def test_the_weights_are_fetched_once_unless_it_is_a_dry_run_or_switched_off(
    fetched: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for fetch, dry_run, said in ((False, False, "xrgs-data lpips"), (True, True, "64 MB")):
        provide_lpips(fetch=fetch, dry_run=dry_run)
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert fetched == []
    provide_lpips(fetch=True, dry_run=False)
    assert fetched == [{"patient": False}]
    text = capsys.readouterr().err
    assert "lpips.fetch=false" in text
    assert text.endswith("LPIPS: fetched\n")

    def offline(**_: Any) -> str:
        raise XrgsError("pip could not fetch it")

    monkeypatch.setattr(download, "fetch_weights", offline)
    provide_lpips(fetch=True, dry_run=False)
    assert capsys.readouterr().err.count("are trained now: pip could not fetch it") == 1
    monkeypatch.setattr(weights, "find_weights", lambda: "a file")
    provide_lpips(fetch=True, dry_run=False)
    assert capsys.readouterr().err == ""
    assert len(fetched) == 1
