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

HR, LR = 200**2, 100**2
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

    def pixels(_: Path, variant: str, __: Conf) -> tuple[float, int]:
        if variant not in made.sides:
            raise StoreError("damaged")
        return made.sides[variant] ** 2, made.sides[variant] ** 2

    monkeypatch.setattr(estimate, "_pixels", pixels)
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


def test_pixels_scale_time_memory_and_disk(past: Past) -> None:
    past.add(100.0, overhead=5.0)
    found, alike = past.cost(variant="large"), past.cost()
    assert found.seconds == pytest.approx(4 * 105)
    assert found.memory_bytes == pytest.approx(4e9)
    assert found.disk_bytes == pytest.approx(4 * alike.disk_bytes)
    # Of a variant that is not built, or can't be read, the nearest known sizes are taken.
    assert past.cost(variant=None) == past.cost(variant="unreadable") == alike


def test_loading_and_scoring_come_on_top(past: Past) -> None:
    past.add(40.0, overhead=5.0)
    assert past.cost() == replace(past.cost(), seconds=45.0, scoring_s=5.0)
    for seconds in (50.0, 99.0):
        past.add(seconds, overhead=1e8)  # the dates of a store that was copied
    assert past.cost().seconds == pytest.approx(50)  # the median of equally near cells


def test_cells_of_this_processor_are_nearer(past: Past) -> None:
    past.add(10.0)
    past.add(30.0, cpu="another", machines_in_turn="")
    past.add(50.0, machines_in_turn="this and another in turn")
    assert past.cost().seconds == pytest.approx(10)


def test_damaged_cells_are_left_out(past: Past) -> None:
    past.add(40.0)
    past.add(40.0)
    (past.store.cell("cell1").path / "summary.json").write_text('{"training_time_s": "soon"}')
    assert CostEstimator(past.store).known == 1
    assert past.cost().seconds == pytest.approx(40)


@pytest.mark.parametrize(
    ("overrides", "mean"),
    [
        ([], (HR + LR) / 2),
        (["train.hr_share=0.8"], 0.8 * HR + 0.2 * LR),
        (["train.views=lr_only", "train.hr_share=0.8"], LR),
        (["train.views=all_hr"], HR),
        (["+ablation=supersampled"], (HR + 4 * LR) / 2),  # LR views at twice their size
    ],
)
def test_the_pixels_of_a_cell_are_those_of_the_views_that_it_draws(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    compose: Callable[..., Conf],
    overrides: list[str],
    mean: float,
) -> None:
    def view(name: str, split: str, tag: str, side: int) -> SimpleNamespace:
        need = {"HR": 1.2, "LR": 4.8}[tag]
        return SimpleNamespace(
            name=name, split=split, tag=tag, width=side, height=side, supersampling=need
        )

    views = [
        *(view(name, "train", "HR", 200) for name in "ab"),
        *(view(name, "train", "LR", 100) for name in "cd"),
        *(view(name, "original", "HR", 200) for name in "cd"),
        view("e", "test", "HR", 999),
    ]

    def read(folder: Path) -> SimpleNamespace:
        assert folder == tmp_path / "trimmed-k-1"
        return SimpleNamespace(views=views)

    (tmp_path / "trimmed-k-1").mkdir()
    estimate.read_views.cache_clear()
    monkeypatch.setattr(saved_variant, "read_manifest", read)
    drawn, largest = estimate._pixels(tmp_path, "k-1", compose(*overrides))
    assert drawn == pytest.approx(mean)
    assert largest == (LR if "lr_only" in str(overrides) else HR)
