"""Tests of what is removed from a store, what is left, and that leases are respected."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.runtime import lease
from xrgs.store.attempts import remove_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store
from xrgs.sweep.cleaning import GARBAGE, Plan, carry_out, plan_gc, plan_removal, plan_trim


def add_variant(store: Store, name: str, age_s: float = 86400) -> None:
    images = store.variants / name / "images"
    images.mkdir(parents=True)
    (images / "a.png").write_bytes(bytes(5000))
    os.utime(store.variants / name, (0, time.time() - age_s))


def add_done(cells: Any, name: str, **identity: Any) -> None:
    cell = cells.begin(name, identity)
    (cell.path / "renders").mkdir()
    (cell.path / "renders" / "a.png").write_bytes(bytes(1000))
    (cell.path / "splats.ply").write_bytes(bytes(2000))
    cells.finish(cell)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty store."""
    store = Store(tmp_path / "s")
    store.prepare()
    return store


@pytest.fixture(autouse=True)
def _filled(store: Store, cells: Any) -> None:
    """Something of each kind in the store."""
    add_done(cells, "done1", variant="aa-used")
    cells.begin("half1", {"variant": "aa-used"})
    for _ in range(2):  # the second one sets the first try aside
        cells.begin("fail1", {"variant": "aa-used"}).fail("out of luck")
    add_done(cells, "old1", variant="aa-old", code={"core": "0"})
    for name in ("aa-used", "aa-old", "trimmed-aa-orphan", "failed-aa"):
        add_variant(store, name)
    add_variant(store, "aa-new", age_s=60)
    (store.variants / ".aa-used.aside-1").mkdir()
    (store.cells_folder / "done1.rerun-1").mkdir()
    (store.cells_folder / ".done1.old-0a").mkdir()
    cells.record(("old1", "s", "l"))


def names(store: Store) -> set[str]:
    return {f"c/{path.name}" for path in store.cells_folder.iterdir()} | {
        f"v/{path.name}" for path in store.variants.iterdir()
    }


def gc(store: Store, *of: str) -> Plan:
    return plan_gc(store, store.cell_rows(), of or GARBAGE)


def test_gc_says_what_it_removes_and_removes_that_alone(store: Store) -> None:
    before = names(store)
    plan = gc(store)
    text = str(plan)
    assert "cells of old code (1), failed cells (1), failed scenes (1)" in text
    assert "reports of 1 sweep lose the numbers of 1 done cell" in text
    assert "left alone, new and without a cell: 1 variant" in text
    assert names(store) == before
    freed, left = carry_out(store, plan)
    assert left == []
    assert freed == sum(item.bytes for item in plan.items) > 15_000
    assert before - names(store) == {
        *("c/old1", "c/fail1", "c/fail1.aside-1"),
        *("v/aa-old", "v/trimmed-aa-orphan", "v/failed-aa", "v/.aa-used.aside-1"),
    }
    assert names(store) < before
    assert not list(store.leases.iterdir())
    assert gc(store).items == ()


@pytest.mark.parametrize(
    ("of", "kinds"),
    [
        ("old_code", {"cells of old code"}),
        ("failed", {"failed cells", "failed scenes"}),
        ("aside", {"folders that were set aside"}),
        ("variants", {"variants without a cell"}),
    ],
)
def test_gc_removes_one_kind(store: Store, of: str, kinds: set[str]) -> None:
    assert {item.kind for item in gc(store, of).items} == kinds
    with pytest.raises(XrgsError, match="of=cells: choose from: old_code, failed"):
        gc(store, "cells")
    if of == "variants":  # the cell of old code is still there, and so is its variant
        assert [item.name for item in gc(store, of).items] == ["variants/trimmed-aa-orphan"]


def test_no_variant_is_removed_or_trimmed_while_a_cell_is_trained(store: Store) -> None:
    assert lease.acquire(store.leases, "half1") is not None
    notes = ("variants are left alone: a sweep is running, and may need any of them",)
    assert gc(store, "variants") == Plan("remove", (), notes)
    cells = store.cell_rows()
    assert plan_trim(store, cells, cells[:1], variants=True).notes[-1:] == notes


def test_no_variant_is_removed_where_an_identity_cannot_be_read(store: Store) -> None:
    (store.cell("half1").path / "identity.json").write_text("{")
    assert gc(store, "variants").items == ()


def test_a_cell_that_is_trained_is_never_touched(store: Store) -> None:
    chosen = store.cell_rows()
    plan = plan_removal(store, chosen)
    assert len(plan.items) == 4
    held = lease.acquire(store.leases, "half1")  # begun by another sweep after the plan
    assert held is not None
    _, left = carry_out(store, plan)
    name = "half1  motorcycle / ? / seed 0"
    assert left == [f"{name}, unfinished: it is left: a sweep is training it"]
    assert store.cell("half1").state().name == "unfinished"
    assert not store.cell("done1").path.exists()
    plan = plan_removal(store, store.cell_rows())
    assert plan == Plan("remove", (), ("left alone, being trained: 1 cell",))


def test_a_cell_that_has_changed_since_the_plan_is_left(store: Store, cells: Any) -> None:
    plan = plan_removal(store, [cell for cell in store.cell_rows() if cell.id == "fail1"])
    cells.done("fail1")
    assert "it was failed, and is done now" in carry_out(store, plan)[1][0]
    assert store.cell("fail1").state().name == "done"


def test_what_cannot_be_removed_hides_no_other(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def remove(cell: CellFolder) -> None:
        if cell.id == "old1":
            raise PermissionError(13, "Permission denied", "cells/old1")
        remove_cell(cell)

    monkeypatch.setattr("xrgs.sweep.cleaning.remove_cell", remove)
    _, left = carry_out(store, gc(store))
    assert len(left) == 1
    assert left[0].endswith(": cells/old1: Permission denied")
    assert not store.cell("fail1").path.exists()
    assert not list(store.leases.iterdir())


def test_trimmed_cells_stay_done_and_variants_in_use_are_left(store: Store) -> None:
    cells = store.cell_rows()
    plan = plan_trim(store, cells, cells, variants=True)
    assert plan.total == "cells (2), variants (1): 11 kB"
    assert "left alone, not done: 2 cells" in str(plan)
    assert "left alone, with cells that are not done: 1 variant" in str(plan)
    assert carry_out(store, plan) == (11_000, [])
    assert store.cell("done1").state().name == "done"
    assert not (store.cell("done1").path / "renders").exists()
    assert (store.variants / "trimmed-aa-old").is_dir()
    assert (store.variants / "aa-used/images/a.png").exists()
    cells = store.cell_rows()
    assert plan_trim(store, cells, cells, variants=True).items == ()


def test_gc_leaves_cells_whose_program_is_elsewhere(store: Store, cells: Any) -> None:
    add_done(cells, "plugin1", variant="aa-used", components={"plugins": {"gone": {}}})
    plan = gc(store, "old_code")
    assert [item.lease for item in plan.items] == ["old1"]
    assert "left alone, of a backend or component not installed here: 1" in plan.notes
