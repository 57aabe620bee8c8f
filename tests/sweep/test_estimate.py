"""Estimates come from the finished cells that are most like the one that is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json
from xrgs.sweep.estimate import RuntimeEstimator


def identity(variant: str, steps: int, weight: float = 1.0, seed: int = 0) -> dict[str, Any]:
    return {
        "splat": {},
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
