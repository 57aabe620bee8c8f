"""A store's cells as a table, and a cell's results as objects."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.conftest import composed
from tests.store.cells import SCORES, begun, finished, identity, row
from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import variant
from xrgs.mixture.variant import CorruptVariant
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store
from xrgs.training import dataset


def finished_in(store: Store, cell_id: str, *overrides: str, seed: int = 0) -> CellFolder:
    conf = composed("scene=motorcycle", f"seed={seed}", *overrides)
    return finished(store.cell(cell_id), conf, identity(seed))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path / "store")
    made.prepare()
    return made


def test_a_row_has_names_metrics_and_config(store: Store) -> None:
    finished_in(store, "abc", "train.steps=20", seed=3)
    store.write_sweep(["x"], [row("abc", "consistency"), row(None, "baseline")])
    table = store.cells()
    assert len(table) == 1
    found = table.iloc[0]
    assert found[["cell_id", "scene", "label", "condition"]].tolist() == [
        *("abc", "fern", "consistency", "")
    ]
    assert (found["seed"], found["variant"], found["state"]) == (3, "key-hash", "done")
    assert (found["psnr"], found["ssim"]) == (25.25, 0.625)
    assert math.isnan(found["lpips"]), "one view lacks it"
    assert (found["gaussians"], found["training_time_s"]) == (7, 1.5)
    assert (found["train.steps"], found["splat.raster.near"]) == (20, 0.01)
    assert "store" not in table, "paths are not what a cell is"
    assert found["evaluations"] == 1e4


def test_cells_are_sorted_and_those_that_are_not_done_are_rows_too(store: Store) -> None:
    finished_in(store, "c")
    finished_in(store, "b", seed=1)
    finished_in(store, "a", seed=0)
    begun(store.cell("d"), what=identity(7)).fail("out of memory")
    (store.cells_folder / "c.aside-1").mkdir()
    (store.cells_folder / "e").mkdir()
    store.write_sweep(["x"], [row(name, "baseline") for name in "ab"])
    table = store.cells().set_index("cell_id")
    assert list(table.index) == ["a", "b", "c", "d", "e"]
    assert list(table["state"]) == ["done", "done", "done", "failed", "planned"]
    assert table.loc["d", "reason"] == "out of memory"
    assert table.loc["d", "seed"] == 7
    assert table["label"].isna().tolist() == [False, False, True, True, True]
    assert table.loc["c", "scene"] == "motorcycle", "without a sweep, the config names the scene"
    assert table.loc[["d", "e"], "psnr"].isna().all()


def test_the_latest_sweep_names_a_cell(store: Store) -> None:
    finished_in(store, "abc")
    for time, label in ((2, "new"), (1, "old")):
        sweep_id = store.write_sweep(["x"], [row("abc", label)])
        os.utime(store.path / "sweeps" / f"{sweep_id}.json", (time, time))
    assert store.cells()["label"].tolist() == ["new"]


def test_a_changed_result_is_corrupt_unless_hashes_are_not_compared(store: Store) -> None:
    cell = finished_in(store, "abc")
    (cell.path / "scores.csv").write_text(SCORES.replace("20.5", "99.5"))
    assert store.cells()["state"].tolist() == ["corrupt"]
    assert store.cells()["psnr"].isna().all()
    assert store.cells(verify=False)["psnr"].tolist() == [(99.5 + 30) / 2]


def test_an_empty_store_has_an_empty_table_and_no_store_is_an_error(
    store: Store, tmp_path: Path
) -> None:
    table = store.cells()
    assert table.empty
    assert {"cell_id", "state", "psnr"} <= set(table.columns)
    with pytest.raises(StoreError, match="nothing is not a store; xrgs-sweep makes one"):
        Store(tmp_path / "nothing").cells()


@pytest.mark.parametrize("value", [[], 10**400, {"a": {"\x1b[2J": "\x1b[2J"}}])
def test_damaged_files_make_a_row(store: Store, value: object) -> None:
    cell = finished_in(store, "abc")
    cell.status_file.unlink()
    for name in ("config.json", "identity.json"):
        (cell.path / name).write_text(json.dumps({"seed": value, "variant": value, "train": value}))
    table = store.cells()
    assert len(table) == 1
    assert table["seed"].isna().all()
    assert "\x1b" not in table.to_csv()


def test_scores_are_a_table_by_view(store: Store) -> None:
    scores = finished_in(store, "abc").scores()
    assert scores.index.name == "view"
    assert scores["psnr"].to_dict() == {"a": 20.5, "b": 30.0}
    assert scores["lpips"].isna().tolist() == [True, False]


@pytest.mark.parametrize("variant_id", ["../x", 3])
def test_a_variant_elsewhere_is_refused(store: Store, variant_id: object) -> None:
    cell = finished_in(store, "abc")
    with pytest.raises(CorruptVariant, match="key-hash"):  # it is not there
        cell.cameras()
    with pytest.raises(XrgsError, match="splats"):  # it is none
        cell.gaussians()
    content = msgspec.to_builtins(identity()) | {"variant": variant_id}
    (cell.path / "identity.json").write_text(json.dumps(content))
    with pytest.raises(StoreError, match=r"damaged: .*identity\.json: variant: "):
        cell.dataset()


def test_a_cells_views_are_those_that_it_was_trained_on_and_scored(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[Any] = []
    monkeypatch.setattr(variant, "load", lambda _: "frozen")
    monkeypatch.setattr(dataset, "load", lambda *views, **held: loaded.append((views, held)))
    changes = ("train.views=hr_only", "train.validation=0.25")
    finished_in(store, "abc", *changes, seed=3).dataset()
    assert loaded == [(("frozen", "hr_only"), {"validation": 0.25, "seed": 3})]
