"""Tests of the lists of a store's cells and sweeps, and of the choice of cells."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from xrgs.cli.store import Filter
from xrgs.errors import XrgsError
from xrgs.runtime import lease
from xrgs.store.store import Store
from xrgs.sweep.status import list_cells, list_sweeps, show


@pytest.fixture
def store(tmp_path: Path, cells: Any) -> Store:
    """Three cells of a sweep, of which one is not begun, and a cell of no sweep, of old code."""
    store: Store = cells.store
    large = cells.begin("abc1")
    (large.path / "splats.ply").write_bytes(bytes(3_000_000))
    cells.finish(large)
    cells.begin("abd2")
    old = cells.done("old3", {"code": {"core": "0"}})
    os.utime(old.status_file, (0, time.time() - 3 * 86400))
    cells.record(("abc1", "fern", "baseline"), ("abd2", "fern", "mip"), ("gone", "room", "mip"))
    return store


def chosen(store: Store, **of: object) -> list[str]:
    return [cell.id for cell in Filter(**of, store=store.path).chosen()[1]]  # type: ignore[arg-type]


def test_cells_are_chosen_by_name_state_age_and_size(store: Store) -> None:
    assert chosen(store) == ["abc1", "abd2", "old3"]
    assert chosen(store, ids=("abc", "o")) == ["abc1", "old3"]
    assert chosen(store, scenes=("fern",)) == ["abc1", "abd2"]
    assert chosen(store, ablations=("mip",)) == ["abd2"]
    assert chosen(store, states=("done",), scenes=("fern",)) == ["abc1"]
    assert chosen(store, sweep=(store.sweep_ids()[0],)) == ["abc1", "abd2"]
    assert chosen(store, older_days=2.9) == ["old3"]
    assert chosen(store, older_days=3.1) == []
    assert chosen(store, larger_mb=2.9) == ["abc1"]


@pytest.mark.parametrize(
    ("of", "message"),
    [
        ({"ids": ("ab",)}, "ab: several cells have such an id or scene: abc1, abd2"),
        ({"ids": ("x",)}, "x: no cells have such an id"),
        ({"scenes": ("frn",)}, "scenes=frn: no cell has that; choose from: fern, motorcycle"),
        ({"states": ("dun",)}, "states=dun: .*choose from: done, running"),
        ({"sweep": ("0",)}, "sweep=0: no cell has that; choose from: [0-9a-f]{16}$"),
    ],
)
def test_a_name_of_nothing_is_refused(
    store: Store, of: dict[str, tuple[str, ...]], message: str
) -> None:
    with pytest.raises(XrgsError, match=message):
        chosen(store, **of)


def test_the_list_tells_states_and_old_code_and_sorts(store: Store) -> None:
    text = list_cells(store.cell_rows(), "size")
    lines = [line.split() for line in text.splitlines()]
    assert text.splitlines()[0].startswith("3 cells, 3 MB")
    assert lines[-1][:5] == ["abc1", "fern", "baseline", "0", "done"]
    assert lines[-1][-2:] == ["3", "MB"]
    (old,) = [line for line in lines if line[:1] == ["old3"]]
    assert old[1:9] == ["motorcycle", "?", "0", "done", "(old", "code)", "3", "d"]
    assert list_cells(store.cell_rows(), "age").splitlines()[-1].startswith("old3")


def test_sweeps_are_listed_with_what_is_done(store: Store, cells: Any) -> None:
    first = store.sweep_ids()[0]
    held = lease.acquire(store.leases, "abd2")
    assert held is not None
    second = cells.record(("abc1", "a\nb", "x"), error="no points")
    os.utime(store.path / "sweeps" / f"{second}.json", (0, 5e9))
    lines = list_sweeps(store.sweep_rows()).splitlines()
    assert lines[0] == "2 sweeps"
    assert lines[-2].startswith(first)
    assert lines[-2].endswith("fern, room  baseline, mip  1 of 3 done, 1 running, 1 pending")
    assert lines[-1].endswith("a b         x              0 of 1 done, 1 failed")
    held.release()
    assert "1 of 3 done, 2 pending" in list_sweeps(store.sweep_rows())


def test_a_cell_is_shown_with_what_differs_from_its_baseline(store: Store, cells: Any) -> None:
    steps = replace(cells.conf.train, steps=7)
    cell = cells.done(train=steps)
    cells.record((cell.id, "fern", "fewer"), baseline_id="abc1")
    _, (row,) = Filter((cell.id,), store=store.path).chosen()
    lines = show(store, row).splitlines()
    assert lines[0] == f"cell {cell.id}  fern / fewer / seed 0"
    at = lines.index("differs from its baseline abc1 in:")
    assert lines[at + 1] == f"  train.steps: {cells.conf.train.steps} -> 7"
    assert "  psnr: 20 dB" in lines
    assert not any("nan" in line for line in lines)
    assert "  scores.csv  15 B" in lines
    (cell.path / "scores.csv").write_text("view,psnr,lpips\na,20,\nb,20,0.5\n")
    lines = show(store, row).splitlines()
    assert "  psnr: 20 dB" in lines


def test_the_table_of_a_store_agrees_with_its_views(store: Store) -> None:
    table = store.cells().set_index("cell_id")
    rows = {row.id: (row.state.name, row.seed) for row in store.cell_rows()}
    assert {name: tuple(row) for name, row in table[["state", "seed"]].iterrows()} == rows
