"""Tests of the lists of a store's cells and sweeps, and of the choice of cells."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from xrgs.errors import XrgsError
from xrgs.experiment import identity
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.store import Store
from xrgs.sweep import locks
from xrgs.sweep.inventory import Selection, list_cells, list_sweeps, summaries


def add(store: Store, name: str, *, done: bool = True, code: dict[str, str] | None = None) -> None:
    """Add a cell of the torch backend, of the installed code or of another one."""
    folder = store.cell(name)
    what = {"splat": {"backend": "torch"}, "arithmetic": "torch", "seed": 0, "variant": "v-w"}
    begin_attempt(folder, {"scene": {"name": "statue"}}, what | {"code": code or installed()})
    if done:
        (folder.path / "splats.ply").write_bytes(bytes(3_000_000 if name == "abc1" else 10))
        (folder.path / "scores.csv").write_text("view,psnr\na,20\n")
        folder.finish(["a"], 1)


def installed() -> dict[str, str]:
    return dict(identity.training_code("torch"))


def row(cell_id: str | None, scene: str, label: str, **more: object) -> dict[str, object]:
    return {"cell_id": cell_id, "scene": scene, "label": label, "condition": ""} | more


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Three cells of a sweep, of which one is not begun, and a cell of no sweep, of old code."""
    store = Store(tmp_path / "s")
    store.prepare()
    add(store, "abc1")
    add(store, "abd2", done=False)
    add(store, "old3", code=installed() | {"splat/densify.py": "0", "plugins/x/a.py": "1"})
    os.utime(store.cell("old3").path / "status.json", (0, time.time() - 3 * 86400))
    rows = [row("abc1", "fern", "baseline"), row("abd2", "fern", "mip"), row("gone", "room", "mip")]
    store.write_sweep(["+ablation=mip"], rows)
    return store


def chosen(store: Store, **of: object) -> list[str]:
    return [cell.id for cell in Selection(**of).of(summaries(store))]  # type: ignore[arg-type]


def test_cells_are_chosen_by_name_state_age_and_size(store: Store) -> None:
    assert chosen(store) == ["abc1", "abd2", "old3"]
    assert chosen(store, ids=("abc", "o")) == ["abc1", "old3"]
    assert chosen(store, scenes=("fern",)) == ["abc1", "abd2"]
    assert chosen(store, ablations=("mip",)) == ["abd2"]
    assert chosen(store, states=("done",), scenes=("fern",)) == ["abc1"]
    assert chosen(store, sweeps=(store.sweep_ids()[0],)) == ["abc1", "abd2"]
    assert chosen(store, older_days=2.9) == ["old3"]
    assert chosen(store, older_days=3.1) == []
    assert chosen(store, larger_mb=2.9) == ["abc1"]


@pytest.mark.parametrize(
    ("of", "message"),
    [
        ({"ids": ("ab",)}, "ab: several cells have such an id: abc1, abd2"),
        ({"ids": ("x",)}, "x: no cells have such an id"),
        ({"scenes": ("frn",)}, "scenes=frn: no cell has that; choose from: fern, statue"),
        ({"states": ("dun",)}, "states=dun: .*choose from: done, running"),
        ({"sweeps": ("0",)}, "sweep=0: no cell has that; choose from: [0-9a-f]{16}$"),
    ],
)
def test_a_name_of_nothing_is_refused(
    store: Store, of: dict[str, tuple[str, ...]], message: str
) -> None:
    with pytest.raises(XrgsError, match=message):
        chosen(store, **of)


def test_the_list_tells_states_and_old_code_and_sorts(store: Store) -> None:
    text = list_cells(summaries(store), "size")
    lines = [line.split() for line in text.splitlines()]
    assert text.splitlines()[0].startswith("3 cells, 3 MB")
    assert lines[-1][:5] == ["abc1", "fern", "baseline", "0", "done"]
    assert lines[-1][-2:] == ["3", "MB"]
    (old,) = [line for line in lines if line[:1] == ["old3"]]
    assert old[1:9] == ["statue", "?", "0", "done", "(old", "code)", "3", "d"]
    assert list_cells(summaries(store), "age").splitlines()[-1].startswith("old3")
    with pytest.raises(XrgsError, match="sort=colour"):
        list_cells(summaries(store), "colour")


def test_code_of_a_plugin_alone_is_no_old_code(store: Store) -> None:
    add(store, "plugin", code=installed() | {"plugins/x/a.py": "1"})
    found = {cell.id: cell for cell in summaries(store)}
    assert found["plugin"].old_code == ()
    assert found["plugin"].stale == ("plugins/x/a.py",)
    assert found["old3"].old_code == ("splat/densify.py",)


def test_sweeps_are_listed_with_what_is_done(store: Store) -> None:
    first = store.sweep_ids()[0]
    lock = locks.acquire(store.locks, "abd2")
    assert lock is not None
    second = store.write_sweep([], [row("abc1", "a\nb", "x", error="no points")])
    os.utime(store.path / "sweeps" / f"{second}.json", (0, 5e9))
    lines = list_sweeps(store.path).splitlines()
    assert lines[0] == "2 sweeps"
    assert lines[-2].startswith(first)
    assert lines[-2].endswith("fern, room  baseline, mip  1 of 3 done, 1 running, 1 pending")
    assert lines[-1].endswith("a b         x              0 of 1 done, 1 failed")
    lock.release()
    assert "1 of 3 done, 2 pending" in list_sweeps(store.path)
