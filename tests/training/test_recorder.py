"""The record of a training run: rows of the history, counts, memory, work and time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace

import pytest
import torch

from tests.conftest import composed as compose
from xrgs.config import Conf
from xrgs.splat.gaussians import Gaussians, from_points
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import Render
from xrgs.splat.settings import OptimizerSettings
from xrgs.splat.strategy.refinement import Refinement
from xrgs.training import loop, recorder
from xrgs.training.components import Step
from xrgs.training.dataset import Dataset
from xrgs.training.recorder import TrainingRecorder


@pytest.fixture
def gaussians(data: Dataset) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    return from_points(data.points, data.colors, init_opacity=0.1, sh_degree=0, generator=generator)


@pytest.fixture
def optimizer(gaussians: Gaussians) -> SplatOptimizer:
    return SplatOptimizer(gaussians, OptimizerSettings(), scene_scale=1.0, steps=10)


@pytest.fixture
def record(data: Dataset, gaussians: Gaussians) -> Callable[..., None]:
    """(recorder, number, of, log, evaluations) records a step on view v<number % 4>.

    Its loss is a tenth of its number.
    """

    def recorded(
        to: TrainingRecorder,
        number: int,
        of: int,
        log: Mapping[str, float] | None = None,
        evaluations: int = 0,
    ) -> None:
        step = Step(number, of, data.train[number % 4], dict(log or {}))
        empty = torch.empty(0)
        render = Render(empty, empty, empty, evaluations, 0, tile_evaluations=0)
        to.record_step(step, torch.tensor(number / 10), render, gaussians, sh_degree=0)

    return recorded


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        (3, [0, 1, 2]),
        (399, list(range(399))),
        (400, [*range(0, 400, 2), 399]),
        (1003, [*range(0, 1003, 5), 1002]),
    ],
)
def test_there_are_about_200_rows_and_one_of_the_last_step(
    steps: int,
    expected: list[int],
    record: Callable[..., None],
    data: Dataset,
    gaussians: Gaussians,
) -> None:
    training = TrainingRecorder(steps, 2e-4, data.train)
    for number in range(steps):
        record(training, number, steps)
    history = training.finish(gaussians, memory_bytes=0).history
    assert [row["step"] for row in history] == expected
    assert [row["view"] for row in history] == [f"v{number % 4}" for number in expected]
    assert [row["loss"] for row in history] == pytest.approx([n / 10 for n in expected])
    assert {row["gaussians"] for row in history} == {60}


def test_every_row_has_every_column(
    record: Callable[..., None], data: Dataset, gaussians: Gaussians
) -> None:
    training = TrainingRecorder(3, 2e-4, data.train)
    record(training, 0, 3)
    training.record_refinement(Refinement(duplicated=2, by_group={"grown_HR": 1}))
    record(training, 1, 3, {"mip.filter": 3.0})
    record(training, 2, 3)
    first, second, third = training.finish(gaussians, memory_bytes=0).history
    assert list(first) == list(second) == list(third)
    assert (first["grown_HR"], second["grown_HR"], third["grown_HR"]) == (0, 1, 1)
    assert (first["duplicated"], second["duplicated"], third["duplicated"]) == (0, 2, 2)
    assert [row["mip.filter"] for row in (first, second, third)] == [None, 3.0, None]
    assert (third["steps_HR"], third["steps_LR"]) == (2, 1)


def test_a_row_has_the_mean_of_what_was_logged_since_the_row_before(
    record: Callable[..., None], data: Dataset, gaussians: Gaussians
) -> None:
    training = TrainingRecorder(800, 2e-4, data.train)  # a row every 4 steps
    for number in range(9):
        record(training, number, 800, {"a": number} if number not in {2, 3} else None)
    history = training.finish(gaussians, memory_bytes=0).history
    assert [row["a"] for row in history] == [0, (1 + 4) / 2, (5 + 6 + 7 + 8) / 4]


def test_only_training_time_counts_and_a_restored_recorder_adds_to_it(
    monkeypatch: pytest.MonkeyPatch,
    record: Callable[..., None],
    data: Dataset,
    gaussians: Gaussians,
) -> None:
    now = 50.0
    monkeypatch.setattr(recorder, "time", SimpleNamespace(perf_counter=lambda: now))
    first = TrainingRecorder(2, 3e-4, data.train)
    now += 2
    first.lap("forward")
    record(first, 0, 2, {"a": 1.0}, evaluations=5)
    now += 5
    first.record_refinement(Refinement(split=4))
    now += 3
    first.exclude_time(3.0)
    state = first.state_dict()
    now += 1000
    second = TrainingRecorder(2, 3e-4, data.train)
    now += 1
    second.load_state_dict(state)
    now += 20
    second.lap("forward")
    record(second, 1, 2, evaluations=6)
    result = second.finish(gaussians, memory_bytes=7)
    assert result.memory_bytes == 7
    assert result.seconds == 2 + 5 + 20
    assert result.stage_seconds == {"forward": 2 + 20, "densification": 5}
    assert result.evaluations == 11
    assert result.grow_grad2d == 3e-4
    assert [row["step"] for row in result.history] == [0, 1]
    assert [row["split"] for row in result.history] == [0, 4]


def test_the_history_balances_what_densification_did(data: Dataset, short: Conf) -> None:
    result = loop.train(data, short)
    last = result.history[-1]
    assert last["step"] == short.train.steps - 1
    grown = last["duplicated"] + last["split"]
    removed = last["pruned_opacity"] + last["pruned_scale"] + last["pruned_non_finite"]
    assert grown > 0
    # The last refinement comes before the last recorded step, so the counts add up to its number.
    assert last["gaussians"] == 60 + grown - removed == len(result.gaussians)
    assert result.evaluations > 0


def test_the_history_counts_by_group(data: Dataset) -> None:
    conf = compose("train.steps=40", "splat.backend=auto", "+ablation=densify")
    history = loop.train(data, conf).history
    assert len({tuple(row) for row in history}) == 1
    last = history[-1]
    assert last["grown_HR"] > 0
    assert last["grown_LR"] > 0
    grown = last["duplicated"] + last["split"]
    assert max(last["grown_HR"], last["grown_LR"]) <= grown <= last["grown_HR"] + last["grown_LR"]
    assert last["pruned_opacity_HR"] + last["pruned_opacity_LR"] == last["pruned_opacity"]
