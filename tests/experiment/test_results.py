"""A store's cells as a table, and a cell's results as objects."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
import torch

from xrgs.capture import dataset, variant
from xrgs.capture.variant import CorruptVariant
from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.ply import save_ply

SCORES = "view,psnr,ssim,lpips\na,20.5,0.75,\nb,30.0,0.5,0.25\n"


def config(steps: int) -> dict[str, Any]:
    groups = {"scene": {"name": "fern"}, "train": {"steps": steps, "views": "mixed"}}
    return groups | {"splat": {"raster": {"near": 0.01}}, "seed": 3, "store": "/elsewhere"}


def finished(store: Store, cell_id: str, *, steps: int = 10, seed: int = 0) -> CellFolder:
    cell = store.cell(cell_id)
    identity = {"variant": "key-hash", "seed": seed, "train": {"views": "mixed"}}
    begin_attempt(cell, config(steps), identity)
    (cell.path / "scores.csv").write_text(SCORES)
    (cell.path / "history.csv").write_text("step,loss\n0,0.5\n")
    (cell.path / "summary.json").write_text('{"gaussians": 7, "training_time_s": 1.5}')
    cell.finish(["a", "b"], protocol=1)
    return cell


def entry(cell_id: str | None, label: str, scene: str = "fern") -> dict[str, Any]:
    return {"cell_id": cell_id, "label": label, "condition": "", "scene": scene, "seed": 0}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path / "store")
    made.prepare()
    return made


def test_a_row_has_names_metrics_and_config(store: Store) -> None:
    finished(store, "abc", steps=20, seed=3)
    store.write_sweep(["x"], [entry("abc", "consistency"), entry(None, "baseline")])
    table = store.cells()
    assert len(table) == 1
    row = table.iloc[0]
    assert row[["cell_id", "scene", "label", "condition"]].tolist() == [
        *("abc", "fern", "consistency", "")
    ]
    assert (row["seed"], row["variant"], row["state"]) == (3, "key-hash", "done")
    assert (row["psnr"], row["ssim"]) == (25.25, 0.625)
    assert math.isnan(row["lpips"]), "one view lacks it"
    assert (row["gaussians"], row["training_time_s"]) == (7, 1.5)
    assert (row["train.steps"], row["splat.raster.near"]) == (20, 0.01)
    assert "store" not in table, "paths are not what a cell is"
    assert math.isnan(row["evaluations"])


def test_cells_are_sorted_and_those_that_are_not_done_are_rows_too(store: Store) -> None:
    finished(store, "c")
    finished(store, "b", seed=1)
    finished(store, "a", seed=0)
    failed = store.cell("d")
    begin_attempt(failed, config(5), {"seed": 7, "variant": "key-hash"})
    failed.fail("out of memory")
    (store.cells_folder / "c.aside-1").make_folder()
    (store.cells_folder / "e").make_folder()
    store.write_sweep(["x"], [entry(name, "baseline") for name in "ab"])
    table = store.cells().set_index("cell_id")
    assert list(table.index) == ["a", "b", "c", "d", "e"]
    assert list(table["state"]) == ["done", "done", "done", "failed", "unfinished"]
    assert table.loc["d", "reason"] == "out of memory"
    assert (table.loc["d", "seed"], table.loc["d", "train.steps"]) == (7, 5)
    assert table["label"].isna().tolist() == [False, False, True, True, True]
    assert table.loc["c", "scene"] == "fern", "without a sweep, the config names the scene"
    assert table.loc[["d", "e"], "psnr"].isna().all()


def test_the_latest_sweep_names_a_cell(store: Store) -> None:
    finished(store, "abc")
    for time, label in ((2, "new"), (1, "old")):
        sweep_id = store.write_sweep(["x"], [entry("abc", label)])
        os.utime(store.path / "sweeps" / f"{sweep_id}.json", (time, time))
    assert store.cells()["label"].tolist() == ["new"]


def test_a_changed_result_is_corrupt_unless_hashes_are_not_compared(store: Store) -> None:
    cell = finished(store, "abc")
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
    with pytest.raises(StoreError, match="nothing: no store; xrgs-sweep makes one"):
        Store(tmp_path / "nothing").cells()


@pytest.mark.parametrize("value", [[], "x", 10**400, {"a": {"\x1b[2J": "\x1b[2J"}}, None])
def test_files_of_any_content_make_a_row(store: Store, value: object) -> None:
    cell = finished(store, "abc")
    (cell.path / "status.json").unlink()
    for name in ("config.json", "identity.json"):
        (cell.path / name).write_text(json.dumps({"seed": value, "variant": value, "train": value}))
    table = store.cells()
    assert len(table) == 1
    assert table["seed"].isna().all()
    assert "\x1b" not in table.to_csv()


def test_scores_are_a_table_by_view(store: Store) -> None:
    scores = finished(store, "abc").scores()
    assert scores.index.name == "view"
    assert scores["psnr"].to_dict() == {"a": 20.5, "b": 30.0}
    assert scores["lpips"].isna().tolist() == [True, False]


def test_gaussians_are_those_that_were_saved(store: Store) -> None:
    cell = finished(store, "abc")
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    made = Gaussians.from_points(points, torch.ones(5, 3))
    save_ply(cell.path / "splats.ply", made)
    loaded = cell.gaussians()
    assert len(loaded) == 5
    assert all(torch.equal(loaded[name], made[name]) for name in PARAMETERS)


def test_a_config_of_another_schema_is_named(store: Store) -> None:
    with pytest.raises(XrgsError, match=r"config\.json: "):
        finished(store, "abc").config()


@pytest.mark.parametrize(
    "identity",
    [
        {"variant": "../x", "seed": 0, "train": {"views": "mixed"}},
        {"seed": 0, "train": {"views": "mixed"}},
        {"variant": "v"},
        {"train": 1},
    ],
)
def test_a_variant_elsewhere_is_refused(store: Store, identity: dict[str, Any]) -> None:
    cell = finished(store, "abc")
    (cell.path / "identity.json").write_text(json.dumps(identity))
    with pytest.raises(StoreError, match=r"identity\.json: it names no (variant|train\.views)"):
        cell.dataset()


@pytest.mark.parametrize(("train", "validation"), [({}, 0.0), ({"validation": 0.25}, 0.25)])
def test_a_cells_views_are_those_that_it_was_trained_on_and_scored(
    store: Store, train: dict[str, Any], validation: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[Any] = []
    monkeypatch.setattr(variant, "load", lambda _: "frozen")
    monkeypatch.setattr(dataset, "load", lambda *views, **held: loaded.append((views, held)))
    cell = finished(store, "abc")
    identity = {"variant": "v", "seed": 3, "train": {"views": "hr_only"} | train}
    (cell.path / "identity.json").write_text(json.dumps(identity))
    cell.dataset()
    assert loaded == [(("frozen", "hr_only"), {"validation": validation, "seed": 3})]


@pytest.mark.parametrize(("seed", "share"), [(-1, 0.0), ("0", 0.0), (0, 1.0), (0, "0.1")])
def test_a_share_or_seed_that_is_none_is_refused(store: Store, seed: Any, share: Any) -> None:
    cell = finished(store, "abc")
    identity = {"variant": "v", "seed": seed, "train": {"views": "mixed", "validation": share}}
    (cell.path / "identity.json").write_text(json.dumps(identity))
    with pytest.raises(StoreError, match=r"train\.validation or seed is not a number"):
        cell.dataset()


def test_a_variant_that_is_not_there_is_named(store: Store) -> None:
    with pytest.raises(CorruptVariant, match="key-hash"):
        finished(store, "abc").cameras()
