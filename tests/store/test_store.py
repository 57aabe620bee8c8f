"""Tests of a store: records of sweeps, and files that are written whole."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.store.cells import row
from xrgs.errors import StoreError
from xrgs.safeio.atomic import write_json
from xrgs.store.store import _MAX_RECORD_BYTES, Store, unchanged_record


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
    with pytest.raises(StoreError, match=r"nope\.json"):
        store.sweep_record("nope")
    write_json(store.sweeps / "old.json", {"version": 0})
    with pytest.raises(StoreError, match="version"):
        store.sweep_record("old")


def test_an_unwritable_store_names_folder_and_key(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match=r"store=.*file.*can't be written.*store="):
        Store(tmp_path / "file").prepare()


def test_the_bounds_of_a_record(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.prepare()
    cell = row("0123456789abcdef", "consistency")
    many = store.write_sweep([], [replace(cell, seed=seed) for seed in range(1000)])
    assert (store.sweeps / f"{many}.json").stat().st_size < _MAX_RECORD_BYTES / 100
    assert len(unchanged_record(store.sweeps / f"{many}.json").cells) == 1000
    wrong: Any
    for wrong in (-1, 0.5, None, True, 2**63):
        malformed = store.write_sweep([], [replace(cell, variant_seed=wrong)])
        with pytest.raises(StoreError, match=rf"{malformed}\.json: cells\[0\]\.variant_seed: "):
            store.sweep_record(malformed)
    long = store.write_sweep([], [replace(cell, label="x" * 2001)])
    with pytest.raises(StoreError, match=rf"{long}\.json: cells\[0\]\.label: "):
        store.sweep_record(long)
