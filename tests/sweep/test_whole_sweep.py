"""Tests of whole sweeps: one JSON for each config, and cells on another disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from xrgs.experiment.store import Store

pytestmark = pytest.mark.slow

SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=2", "+ablation=consistency")


def has_config(value: object) -> bool:
    """Return whether a JSON value holds a cell's config."""
    if isinstance(value, dict):
        return {"train", "components", "store"} <= value.keys() or any(
            map(has_config, value.values())
        )
    return isinstance(value, list) and any(map(has_config, value))


def test_a_config_is_written_once_and_cells_may_be_on_another_disk(
    sweeps_in: Callable[..., Any],
    run_command: Callable[..., tuple[int, str, str]],
    tmp_path: Path,
) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "cells").symlink_to(tmp_path / "disk")
    sweeps = sweeps_in(tmp_path)
    code, table, err = sweeps.run(*SMOKE)
    assert code == 0, err
    assert err.count("training cell") == 2
    store = Store(tmp_path / "s")
    names = [cell.id for cell in store.cell_folders()]
    assert sorted(path.name for path in (tmp_path / "disk").iterdir()) == names

    files = {file for file in tmp_path.rglob("*.json") if "reports" not in file.parts}
    files |= set((tmp_path / "disk").rglob("*.json"))
    with_config = {file for file in files if has_config(json.loads(file.read_text()))}
    assert {file.resolve() for file in with_config} == {
        tmp_path / "disk" / name / "config.json" for name in names
    }

    code, again, err = sweeps.run(*SMOKE)
    assert code == 0, err
    assert "training cell" not in err
    assert again == table
    code, listed, err = run_command("store", tmp_path, "list", "--store=s")
    assert code == 0, err
    assert listed.count("done") == 2
    assert set(store.cells()["state"]) == {"done"}
    code, report, err = run_command("report", tmp_path, "--store=s")
    assert code == 0, err
    assert report == table
