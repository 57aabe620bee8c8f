"""Tests of the summary of a store."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from xrgs.errors import XrgsError
from xrgs.experiment import identity
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.runtime.progress import Progress
from xrgs.safeio.atomic import write_json
from xrgs.sweep import locks, status
from xrgs.sweep.status import describe, read


def cell(
    store: Store, name: str, code: dict[str, str] | None = None, **changes: object
) -> CellFolder:
    """A cell that was begun, with these changes of its identity; None removes a key."""
    folder = store.cell(name)
    what: dict[str, object] = {"splat": {"backend": "torch"}, "arithmetic": "torch"}
    what["code"] = code or identity.training_code("torch")
    what |= changes
    folder.begin({"scene": {"name": "statue"}}, {k: v for k, v in what.items() if v is not None})
    return folder


def done(
    store: Store, name: str, code: dict[str, str] | None = None, **changes: object
) -> CellFolder:
    folder = cell(store, name, code, **changes)
    (folder.path / "scores.csv").write_text("view,psnr\na,20\n")
    folder.finish(["a"], 1)
    return folder


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A store with a cell of each kind."""
    store = Store(tmp_path / "s")
    store.prepare()
    done(store, "good")
    now = identity.training_code("torch")
    done(store, "stale", now | {"splat/densify.py": "0", "gone.py": "1"})
    (done(store, "corrupt").path / "scores.csv").write_text("view\n")
    done(store, "twice")
    done(store, "twice")
    cell(store, "stopped")
    cell(store, "failed").fail("ended by SIGKILL\nand more")
    busy = cell(store, "busy")
    write_json(busy.progress, asdict(Progress("training", "step", 20, 80, 3.0)))
    assert locks.acquire(store.locks, "busy") is not None
    (store.variants / "fa-bb").make_folder()
    (store.variants / "failed-aa").make_folder()
    rows = [("good", "statue", "baseline"), ("stale", "statue", "consistency"), (None, "fern", "x")]
    store.write_sweep(
        ["a"],
        [
            {"cell_id": name, "scene": scene, "label": label, "condition": ""}
            for name, scene, label in rows
        ],
    )
    return store


def test_every_cell_is_counted_and_told_why(store: Store) -> None:
    text = describe(read(store.path))
    assert "7 cells" in text
    assert "3 done, 1 running, 1 unfinished, 1 failed, 1 corrupt" in text
    assert "1 folders of earlier attempts" in text
    assert "1 variants, 1 sweeps" in text
    assert "failed  statue / ?  ended by SIGKILL\n" in text
    assert f"process {os.getpid()} on" in text
    assert ": training 20 of 80 steps, 3 steps/s, ~20 s left" in text
    assert "scores.csv is missing or has another size" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["statue", "baseline", "1"] in lines
    assert ["statue", "consistency", "1", "1"] in lines


def test_a_stale_cell_names_the_files_that_are_others_now(store: Store) -> None:
    stale = {cell.id: cell.stale for cell in read(store.path).cells if cell.stale}
    assert stale == {"stale": ("gone.py", "splat/densify.py")}
    text = describe(read(store.path))
    assert "stale: 1 done cells" in text
    assert "  splat/densify.py: 1 cells" in text


def test_a_cell_of_another_arithmetic_is_stale(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, native = identity.training_code("native"), {"backend": "native"}
    done(store, "fused", code, arithmetic="fma", splat=native)
    done(store, "unfused", code, arithmetic="no-fma", splat=native)
    # As a cell has it that was trained before the arithmetic was part of the identity.
    done(store, "old", code, arithmetic=None, splat=native)
    monkeypatch.setattr(status, "arithmetic", lambda _: "fma")
    stale = {cell.id: cell.stale for cell in read(store.path).cells}
    assert stale["fused"] == ()
    assert stale["unfused"] == ("arithmetic (no-fma, here fma)",)
    assert stale["old"] == ("arithmetic (not recorded, here fma)",)

    def missing(_: str) -> str:
        raise XrgsError("not built on this machine")

    monkeypatch.setattr(status, "arithmetic", missing)  # where stores are only read
    assert [cell.id for cell in read(store.path).cells if cell.stale] == ["stale"]


def test_a_change_that_keeps_the_size_is_found_where_that_is_asked_for(store: Store) -> None:
    scores = store.cell("good").path / "scores.csv"
    scores.write_text(scores.read_text().replace("20", "99"))
    states = [
        {cell.id: cell.state.name for cell in read(store.path, verify=verify).cells}
        for verify in (False, True)
    ]
    assert [state["good"] for state in states] == ["done", "corrupt"]


def test_it_writes_nothing_and_needs_no_torch(
    run_command: Callable[..., tuple[int, str, str]], store: Store, tmp_path: Path
) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('torch was imported')")
    before = sorted(store.path.rglob("*"))
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    code, out, err = run_command("status", tmp_path, "store=s", PYTHONPATH=path)
    assert code == 0, err
    assert "7 cells" in out
    assert sorted(store.path.rglob("*")) == before


def test_a_folder_that_is_no_store_is_named(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match="nowhere"):
        read(tmp_path / "nowhere")


def test_a_sweep_record_that_cannot_be_read_hides_no_cell(store: Store) -> None:
    (store.path / "sweeps" / "bad.json").write_text("{")
    write_json(store.path / "sweeps" / "other.json", {"cells": [{"cell_id": "good"}]})
    assert len(read(store.path).cells) == 7
