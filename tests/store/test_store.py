"""Tests of a store: records of sweeps, and files that are written whole."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.store.cells import row
from xrgs.errors import StoreError
from xrgs.safeio.atomic import write_json
from xrgs.store.schema import RecordedCell
from xrgs.store.store import Store


def test_the_same_comparison_has_the_same_sweep_id(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.prepare()
    first = store.write_sweep(["a=1"], [row("x")])
    second = store.write_sweep(["a=1"], [row("x", seed=1)])
    assert store.write_sweep(["b=2"], [row("y")]) == first != second
    os.utime(tmp_path / "sweeps" / f"{second}.json", ns=(0, 0))
    assert store.latest_sweep() == first
    assert store.sweep_record().cells == (row("y"),)


def test_a_store_and_its_records_are_on_the_disk(tmp_path: Path, disk_events: list[str]) -> None:
    store = Store(tmp_path)
    store.prepare()
    assert disk_events == [f"sync {tmp_path.name}"]
    sweep = store.write_sweep(["a=1"], [row("x")])
    content, *named = disk_events[1:]
    assert content.startswith(f"sync .{sweep}.json.")
    assert named == [f"name {sweep}.json", "sync sweeps"]


def test_a_store_without_sweeps_says_so(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.prepare()
    with pytest.raises(StoreError, match="is not a store; xrgs-sweep makes one"):
        Store(tmp_path / "nothing").latest_sweep()
    with pytest.raises(StoreError, match="holds no sweep"):
        store.sweep_record()


def test_an_unknown_sweep_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"nope\.json"):
        Store(tmp_path).sweep_record("nope")


def test_a_record_of_another_version_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.prepare()
    (tmp_path / "sweeps" / "old.json").write_text(json.dumps({"version": 0}))
    with pytest.raises(StoreError, match="version"):
        store.sweep_record("old")


def test_an_unwritable_store_names_folder_and_key(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match=r"store=.*file.*can't be written.*store="):
        Store(tmp_path / "file").prepare()


def test_a_file_has_the_rights_that_the_umask_leaves(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_json(tmp_path / "value.json", 1)
    finally:
        os.umask(before)
    assert (tmp_path / "value.json").stat().st_mode & 0o777 == 0o640


def test_an_interrupted_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "value.json"
    write_json(file, 1)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        write_json(file, 2)
    assert json.loads(file.read_text()) == 1
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.slow
def test_the_bounds_of_a_record(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.prepare()
    cell = RecordedCell(
        cell_id="0123456789abcdef",
        label="consistency",
        condition="variant.factor=4",
        scene="garden",
        variant_seed=0,
        seed=0,
        variant_id="0123456789abcdef-0123456789abcdef",
        baseline_id="0123456789abcdef",
    )
    many = store.write_sweep([], [replace(cell, seed=seed) for seed in range(100_000)])
    assert len(store.sweep_record(many).cells) == 100_000
    store.verify_sweep(many)
    wrong: Any
    for wrong in (-1, 0.5, None, True, 2**63):
        malformed = store.write_sweep([], [replace(cell, variant_seed=wrong)])
        with pytest.raises(StoreError, match=rf"{malformed}\.json: cells\[0\]\.variant_seed: "):
            store.sweep_record(malformed)
    long = store.write_sweep([], [replace(cell, label="x" * 2001)])
    with pytest.raises(StoreError, match=rf"{long}\.json: cells\[0\]\.label: "):
        store.sweep_record(long)
