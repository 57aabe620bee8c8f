"""Estimates come from the finished cells that are most like the one that is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from xrgs.config import Conf
from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json
from xrgs.sweep.estimate import TORCH_SLOWDOWN, RuntimeEstimator, torch_seconds


def identity(
    variant: str, steps: int, weight: float = 1.0, seed: int = 0, backend: str = "native"
) -> dict[str, Any]:
    return {
        "splat": {"backend": backend},
        "components": {"weight": weight},
        "train": {"steps": steps, "views": "mixed"},
        "variant": variant,
        "seed": seed,
        "code": {"train.py": str(seed)},
    }


@pytest.fixture
def past(tmp_path: Path) -> RuntimeEstimator:
    """Seconds a step: 1 and 3 of the same at 10 steps, 4 at 20 steps, 5 with another weight."""
    cells = {
        "a": (identity("v", 10, seed=0), 10.0),
        "b": (identity("v", 10, seed=1), 30.0),
        "c": (identity("v", 20), 80.0),
        "d": (identity("v", 10, weight=2.0), 50.0),
        "a.aside-1": (identity("v", 10), 1e9),
        "broken": ({}, 1e9),
    }
    for name, (what, seconds) in cells.items():
        folder = tmp_path / "cells" / name
        folder.mkdir(parents=True)
        write_json(folder / "identity.json", what)
        write_json(folder / "summary.json", {"training_time_s": seconds})
    (tmp_path / "cells" / "unfinished").mkdir()
    return RuntimeEstimator(Store(tmp_path))


@pytest.mark.parametrize(
    ("asked", "seconds"),
    [
        (identity("v", 10, seed=7), 20.0),  # the same but for seed and code: a, b
        (identity("v", 100), 800 / 3),  # but for the number of steps: a, b, c
        (identity("v", 10, weight=9.0), 32.5),  # of the variant: all
        (identity("w", 10), 32.5),  # any
    ],
)
def test_the_most_like_it_count(
    past: RuntimeEstimator, asked: dict[str, Any], seconds: float
) -> None:
    assert past.seconds(asked) == pytest.approx(seconds)


def test_a_store_without_cells_knows_nothing(tmp_path: Path) -> None:
    assert RuntimeEstimator(Store(tmp_path)).seconds(identity("v", 10)) is None


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_cells_of_the_other_backend_count_by_its_speed_until_there_are_own_ones(
    tmp_path: Path, backend: str
) -> None:
    other = {"native": "torch", "torch": "native"}[backend]

    def finished(name: str, what: dict[str, Any], seconds: float) -> RuntimeEstimator:
        folder = tmp_path / "cells" / name
        folder.mkdir(parents=True)
        write_json(folder / "identity.json", what)
        write_json(folder / "summary.json", {"training_time_s": seconds})
        return RuntimeEstimator(Store(tmp_path))

    asked = identity("v", 20, backend=backend)
    past = finished("other", identity("v", 10, backend=other), 3.0)
    times = TORCH_SLOWDOWN if backend == "torch" else 1 / TORCH_SLOWDOWN
    assert past.seconds(asked) == pytest.approx(6.0 * times)
    past = finished("own", identity("w", 10, weight=2.0, backend=backend), 7.0)
    assert past.seconds(asked) == pytest.approx(14.0)


def test_torch_takes_as_long_as_the_pixels_of_the_views(compose: Callable[..., Conf]) -> None:
    conf = compose("variant.long_side=400", "train.steps=100", "variant.hr_fraction=0.3")
    seconds = torch_seconds(conf)
    assert seconds is not None

    def times(**train: object) -> float | None:
        other = torch_seconds(replace(conf, train=replace(conf.train, **train)))  # type: ignore[arg-type]  # names of fields, as given
        return None if other is None else other / seconds

    mixed = 0.3 + 0.7 / 25  # of the pixels of an HR view, in the mean
    assert times(steps=300) == pytest.approx(3)
    assert times(views="lr_only") == pytest.approx(1 / 25 / mixed)
    assert times(views="hr_only") == pytest.approx(1 / mixed)
    assert times(views="all_hr") == pytest.approx(1 / mixed)
    twice = replace(conf, variant=replace(conf.variant, long_side=800))
    assert torch_seconds(twice) == pytest.approx(4 * seconds)
    kept = replace(conf, variant=replace(conf.variant, degradation="jpeg"))
    assert torch_seconds(kept) == pytest.approx(seconds / mixed)
    unknown = replace(conf, variant=replace(conf.variant, long_side=0))
    assert torch_seconds(unknown) is None
