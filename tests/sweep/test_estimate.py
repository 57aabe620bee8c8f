"""Costs are those of the nearest finished cells of a store, scaled to the planned cell."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from xrgs.config import Conf
from xrgs.errors import StoreError
from xrgs.mixture import saved_variant
from xrgs.safeio.atomic import write_json
from xrgs.splat import backend
from xrgs.store import provenance
from xrgs.sweep import estimate
from xrgs.sweep.estimate import TORCH_SLOWDOWN, Cost, CostEstimator

#: The bytes that training holds of the photographs of each variant.
HELD = {"v": 200_000_000, "large": 3_200_000_000}
START = datetime(2026, 1, 1, tzinfo=UTC)


class Past:
    """Finished cells of a store, on variants of views of some pixels a side."""

    def __init__(self, cells: Any, sides: dict[str, int]) -> None:
        self.cells, self.store, self.conf = cells, cells.store, cells.conf
        self.sides = sides
        """The side of the views of each variant, in pixels."""

    def train(self, **changes: Any) -> Conf:
        conf: Conf = replace(self.conf, train=replace(self.conf.train, **changes))
        return conf

    def add(
        self,
        seconds: float,
        conf: Conf | None = None,
        variant: str = "v",
        overhead: float = 0.0,
        gaussians: int = 100_000,
        **made: Any,
    ) -> None:
        conf = conf or self.conf
        changes = {key: getattr(conf, key) for key in ("train", "splat", "components")}
        cell = self.cells.begin(
            f"cell{len(self.store.cell_folders())}", {"variant": variant}, **changes
        )
        self.cells.finish(cell)
        summary = msgspec.structs.replace(
            cell.summary(),
            training_time_s=seconds,
            peak_rss_bytes=1e9,
            gaussians=gaussians,
            steps=conf.train.steps,
        )
        write_json(cell.path / "summary.json", msgspec.to_builtins(summary))
        here = provenance.collect(1, "torch")
        told = msgspec.structs.replace(here, started=START.isoformat(), **made)
        write_json(cell.path / "provenance.json", msgspec.to_builtins(told))
        cell.finish(["a"], {})
        end = START.timestamp() + seconds + overhead
        os.utime(cell.status_file, (end, end))

    def cost(self, conf: Conf | None = None, variant: str | None = "v", threads: int = 1) -> Cost:
        found = CostEstimator(self.store).cost(conf or self.conf, variant, threads)
        assert found is not None
        return found


@pytest.fixture
def past(cells: Any, monkeypatch: pytest.MonkeyPatch) -> Past:
    """A store without finished cells."""
    made = Past(cells, {"v": 300, "large": 600})
    made.conf = made.train(steps=100)

    def sizes(_: Path, variant: str, *__: Any) -> estimate._Sizes:
        if variant not in made.sides:
            raise StoreError("damaged")
        return estimate._Sizes(made.sides[variant] ** 2, made.sides[variant] ** 2, HELD[variant])

    monkeypatch.setattr(estimate, "_sizes", sizes)
    return made


def test_a_store_without_finished_cells_tells_nothing(past: Past) -> None:
    estimator = CostEstimator(past.store)
    assert estimator.known == 0
    assert estimator.cost(past.conf, "v", 1) is None


def test_the_nearest_cell_decides(past: Past) -> None:
    consistency = replace(past.conf.components.consistency, weight=0.5)
    other = replace(past.conf, components=replace(past.conf.components, consistency=consistency))
    past.add(40.0)
    past.add(70.0, other)
    assert past.cost().seconds == pytest.approx(40)
    assert past.cost(other).seconds == pytest.approx(70)


def test_steps_threads_and_backend_scale_the_time(past: Past) -> None:
    past.add(100.0)
    assert past.cost(past.train(steps=300)).seconds == pytest.approx(300)
    assert past.cost(threads=4).seconds == pytest.approx(25)
    native = replace(past.conf, splat=replace(past.conf.splat, backend="native"))
    assert past.cost(native).seconds == pytest.approx(100 / TORCH_SLOWDOWN)


def test_times_of_a_gpu_and_of_a_processor_say_nothing_about_each_other(
    past: Past, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend, "_gsplat_version", lambda: ("1.6.0", 0.99))
    on_gpu = replace(past.conf, splat=replace(past.conf.splat, backend="gsplat"))
    past.add(100.0)
    assert CostEstimator(past.store).cost(on_gpu, "v", 1) is None
    past.add(7.0, on_gpu, backend="gsplat")
    assert past.cost(on_gpu, threads=4).seconds == pytest.approx(7)  # the GPU's, whatever threads
    assert past.cost().seconds == pytest.approx(100)


def test_pixels_and_gaussians_scale_the_time_and_the_memory(past: Past) -> None:
    past.add(100.0, gaussians=90_000)  # as many as a view has pixels
    found = past.cost(variant="large")
    assert found.seconds == pytest.approx(100 * (4 + 1) / 2)
    # The photographs of that variant take 3 GB more, whatever the size of one.
    assert found.memory_bytes == pytest.approx((1e9 - 2e8) * (4 + 1) / 2 + 32e8)
    # Of a variant that is not built, or can't be read, the nearest known sizes are taken.
    assert past.cost(variant=None) == past.cost(variant="unreadable") == past.cost()


def test_a_budget_of_gaussians_limits_disk_and_time(past: Past) -> None:
    past.add(100.0, gaussians=90_000)
    densify = replace(past.conf.splat.densify, budget=0.25)
    few = replace(past.conf, splat=replace(past.conf.splat, densify=densify))
    found, free = past.cost(few), past.cost()
    assert found.disk_bytes == pytest.approx(free.disk_bytes / 4)  # 22,500 of 90,000
    assert found.seconds == pytest.approx(free.seconds * (1 + 0.25) / 2)


def test_natural_selection_takes_gaussians_away_late(past: Past) -> None:
    past.add(100.0, gaussians=90_000)
    selection = replace(past.conf.components.natural_selection, budget=0.25)
    components = replace(past.conf.components, natural_selection=selection)
    found, free = past.cost(replace(past.conf, components=components)), past.cost()
    assert found.disk_bytes == pytest.approx(free.disk_bytes / 4)
    mean = (90_000 + 22_500) / 2
    assert found.seconds == pytest.approx(free.seconds * (90_000 + mean) / (90_000 + 90_000))


def test_the_median_of_equally_near_cells_counts(past: Past) -> None:
    for seconds in (10.0, 12.0, 90.0):
        past.add(seconds)
    assert past.cost().seconds == pytest.approx(12)


def test_loading_and_scoring_come_on_top(past: Past) -> None:
    past.add(40.0, overhead=5.0)
    assert past.cost() == replace(past.cost(), seconds=45.0, scoring_s=5.0)


def test_the_dates_of_a_store_that_was_copied_tell_nothing(past: Past) -> None:
    past.add(40.0, overhead=1e8)
    assert past.cost().seconds == pytest.approx(40)


def test_cells_of_this_processor_are_nearer(past: Past) -> None:
    past.add(10.0)
    past.add(30.0, cpu="another", machines_in_turn="")
    past.add(50.0, machines_in_turn="this and another in turn")
    assert past.cost().seconds == pytest.approx(10)


@pytest.mark.parametrize("spoilt", ["config.json", "summary.json", "provenance.json"])
def test_damaged_cells_are_left_out(past: Past, spoilt: str) -> None:
    past.add(40.0)
    past.add(40.0)
    (past.store.cell("cell1").path / spoilt).write_text('{"training_time_s": "soon"}')
    assert CostEstimator(past.store).known == 1
    assert past.cost().seconds == pytest.approx(40)


@pytest.fixture
def sizes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Conf], estimate._Sizes]:
    """The sizes of a cell on a trimmed variant of two HR and two LR views."""
    estimate.read_views.cache_clear()

    def view(name: str, split: str, tag: str, side: int, need: float) -> SimpleNamespace:
        size = {"width": side, "height": side}
        return SimpleNamespace(name=name, split=split, tag=tag, supersampling=need, **size)

    made = [
        *(view(name, "train", "HR", 200, 1.2) for name in "ab"),
        *(view(name, "train", "LR", 100, 4.8) for name in "cd"),
        *(view(name, "original", "HR", 200, 1.2) for name in "cd"),
        view("e", "test", "HR", 999, 1.0),
    ]

    def read(folder: Path) -> SimpleNamespace:
        assert folder == tmp_path / "trimmed-k-1"
        return SimpleNamespace(views=made)

    monkeypatch.setattr(saved_variant, "read_manifest", read)
    return lambda conf: estimate._sizes(tmp_path, "k-1", conf)


HR, LR = 200**2, 100**2


@pytest.mark.parametrize(
    ("overrides", "pixels"),
    [
        ([], (HR + LR) / 2),
        (["train.hr_share=0.5"], (HR + LR) / 2),
        (["train.hr_share=0.8"], 0.8 * HR + 0.2 * LR),
        (["train.views=hr_only"], HR),
        (["train.views=lr_only", "train.hr_share=0.8"], LR),
        (["train.views=all_hr"], HR),
        # Two HR views are left at least.
        (["train.validation=0.5"], (HR + LR) / 2),
        # LR views need 5 times as many pixels a side, and get 3 times as many in half of the steps.
        (
            ["components.supersampled.factor=3", "components.supersampled.late_factor=1"],
            (HR + LR * (9 + 1) / 2) / 2,
        ),
        # Of a digital zoom, LR views resolve a fifth of their size; at factor 1 they are whole.
        (
            ["components.supersampled.factor=2", "variant.degradation=digital_zoom"],
            (HR + LR * ((2 / 5) ** 2 + 1) / 2) / 2,
        ),
        # HR views at 1/3 of their size in the first tenth of the steps, then 1/2 to a quarter.
        (
            ["components.resolution_schedule.start_share=0.4"],
            (HR * (0.1 / 9 + 0.15 / 4 + 0.75) + LR) / 2,
        ),
        (["components.resolution_schedule.start_share=0"], (HR + LR) / 2),  # training refuses it
    ],
)
def test_a_step_renders_the_pixels_that_the_components_ask_for(
    sizes: Callable[[Conf], estimate._Sizes],
    compose: Callable[..., Conf],
    overrides: list[str],
    pixels: float,
) -> None:
    assert sizes(compose(*overrides)).pixels == pytest.approx(pixels, rel=0.03)


@pytest.mark.parametrize("views", ["mixed", "hr_only", "lr_only", "all_hr"])
@pytest.mark.parametrize("kept", [500_000, 1 << 28])
def test_the_photographs_that_training_holds_are_those_of_its_views(
    monkeypatch: pytest.MonkeyPatch,
    sizes: Callable[[Conf], estimate._Sizes],
    compose: Callable[..., Conf],
    views: str,
    kept: int,
) -> None:
    monkeypatch.setattr(estimate, "KEPT_BYTES", kept)
    found = sizes(compose(f"train.views={views}"))
    assert found.largest == (LR if views == "lr_only" else HR)
    trained = 2 * {"mixed": HR + LR, "hr_only": HR, "lr_only": LR, "all_hr": 2 * HR}[views]
    assert found.held_bytes == 3 * (trained + 999**2) + min(kept, 24 * trained)
