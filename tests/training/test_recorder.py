"""The record of a training run: rows of the history, counts, memory, work and time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from xrgs.splat.gaussians import Gaussians
from xrgs.splat.rendering import Render
from xrgs.splat.strategy.base import Refinement
from xrgs.training import recorder
from xrgs.training.components import Step
from xrgs.training.dataset import Dataset
from xrgs.training.recorder import TrainingRecorder, TrainingResult


@pytest.fixture
def gaussians(data: Dataset) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    return Gaussians.from_points(
        data.points, data.colors, init_opacity=0.1, sh_degree=0, generator=generator
    )


Record = Callable[..., None]


@pytest.fixture
def record(data: Dataset, gaussians: Gaussians) -> Record:
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
    ("steps", "expected"), [(399, range(399)), (1003, [*range(0, 1003, 5), 1002])]
)
def test_there_are_about_200_rows_and_one_of_the_last_step(
    steps: int, expected: Sequence[int], record: Record, data: Dataset, gaussians: Gaussians
) -> None:
    training = TrainingRecorder(steps, 2e-4, data.train)
    for number in range(steps):
        record(training, number, steps, {"a": number})
    history = training.finish(gaussians, memory_bytes=0).history
    assert [row["step"] for row in history] == [*expected]
    assert [row["view"] for row in history] == [f"v{number % 4}" for number in expected]
    assert [row["loss"] for row in history] == pytest.approx([n / 10 for n in expected])
    assert {row["gaussians"] for row in history} == {60}
    # The mean of what was logged since the row before.
    since = pairwise([-1, *expected])
    assert [row["a"] for row in history] == [(first + 1 + last) / 2 for first, last in since]


def test_every_row_has_every_column(record: Record, data: Dataset, gaussians: Gaussians) -> None:
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


def test_only_training_time_counts_and_a_restored_recorder_adds_to_it(
    monkeypatch: pytest.MonkeyPatch,
    record: Record,
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


def test_a_step_is_counted_by_its_render_and_its_photograph(data: Dataset) -> None:
    generator = torch.Generator().manual_seed(0)
    points, colors = torch.rand(7, 3, generator=generator), torch.rand(7, 3, generator=generator)
    gaussians = Gaussians.from_points(
        points, colors, init_opacity=0.1, sh_degree=2, generator=generator
    )
    view = data.train[0]
    width, height = view.camera.width, view.camera.height
    visible = torch.tensor([True, False, True, True, False, True, True])
    first = TrainingRecorder(2, 2e-4, data.train)
    # A component has replaced the view by a smaller one; the photograph is the one of the dataset.
    replaced = dataclasses.replace(view, camera=view.camera.resized(4, 3))
    smaller = Render(torch.empty(3, 4, 3), torch.empty(3, 4), visible, 50, 0, tile_evaluations=60)
    larger = Render(torch.empty(99, 98, 3), torch.empty(99, 98), visible, 1, 0, tile_evaluations=2)
    first.record_step(Step(0, 2, replaced), torch.tensor(0.5), smaller, gaussians, sh_degree=1)
    second = TrainingRecorder(2, 2e-4, data.train)
    second.load_state_dict(first.state_dict())
    second.record_step(Step(1, 2, view), torch.tensor(0.5), larger, gaussians, sh_degree=2)
    assert second.finish(gaussians, 0).work == {
        "views": 1,
        "gaussians": 2 * 7,
        "gaussians_visible": 2 * 5,
        "pixels": 12 + 99 * 98,
        "pixels_photograph": 2 * width * height,
        "pixels_left_out": width * height - 12,
        "pairs": 7 * (12 + 99 * 98),
        "pairs_visible": 5 * (12 + 99 * 98),
        "pairs_in_tiles": 62,
        "sh_coefficients": 2 * 5 * 9,
        "sh_coefficients_left_out": 5 * 5,  # band 2
    }


def test_training_balances_its_counts(data: Dataset, trained: TrainingResult) -> None:
    rows, last, work = trained.history, trained.history[-1], trained.work
    assert [row["step"] for row in rows] == list(range(40))
    grown = last["duplicated"] + last["split"]
    removed = last["pruned_opacity"] + last["pruned_scale"] + last["pruned_non_finite"]
    assert grown > 0
    # The last refinement comes before the last recorded step, so the counts add up to its number.
    assert last["gaussians"] == 60 + grown - removed == len(trained.gaussians)
    sizes = {view.name: view.camera.width * view.camera.height for view in data.train}
    pixels = [sizes[row["view"]] for row in rows]
    assert work["views"] == len({row["view"] for row in rows})
    assert work["gaussians"] == sum(row["gaussians"] for row in rows)
    assert work["pixels"] == work["pixels_photograph"] == sum(pixels)
    assert work["pixels_left_out"] == 0
    pairs = sum(row["gaussians"] * size for row, size in zip(rows, pixels, strict=True))
    assert work["pairs"] == pairs
    assert 0 < work["gaussians_visible"] <= work["gaussians"]
    assert 0 < trained.evaluations <= work["pairs_in_tiles"]
    assert sum(trained.stage_seconds.values()) == pytest.approx(trained.seconds, rel=0.05)
    assert set(trained.stage_seconds) == {"forward", "backward", "optimizer", "densification"}
