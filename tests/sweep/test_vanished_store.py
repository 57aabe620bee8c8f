"""Tests that a store which vanishes is noticed, and that nothing of it reappears."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from xrgs.store.store import Store, StoreGoneError

#: Every cell's process reports that it has begun, and then writes into its folder for ever.
WRITES_ON = """
import sys
if "xrgs.sweep.job" in sys.orig_argv and "cell" in sys.orig_argv:
    import os, time, types
    from pathlib import Path

    def run_cell(conf, variant, folder, stop):
        from xrgs.safeio.atomic import write_json
        (Path(os.environ["SWEEPS_OF"]) / "begun").touch()
        while True:
            write_json(folder.path / "provenance.json", {})
            time.sleep(0.01)

    sys.modules["xrgs.store.cell"] = types.ModuleType("xrgs.store.cell")
    sys.modules["xrgs.store.cell"].run_cell = run_cell
"""


def rename(store: Path) -> None:
    store.rename(store.with_name("moved"))


def delete(store: Path) -> None:
    rename(store)
    moved = store.with_name("moved")
    while moved.exists():
        # A process may write a file between the listing of a folder and its removal.
        with contextlib.suppress(OSError):
            shutil.rmtree(moved)


def unmount(store: Path) -> None:
    """Leave an empty folder, as the place where a disk was mounted."""
    rename(store)
    store.mkdir()


@pytest.mark.parametrize("vanishes", [rename, delete, unmount])
def test_a_store_that_was_moved_is_gone_and_says_where_its_cells_are(
    store: Store, vanishes: Callable[[Path], None]
) -> None:
    store.check_not_gone()
    vanishes(store.path)
    assert store.is_gone
    with pytest.raises(StoreGoneError, match=r"no longer there .*finished cells are where"):
        store.check_not_gone()


def test_a_store_that_can_not_be_looked_at_now_is_not_gone(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, **_: object) -> os.stat_result:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    monkeypatch.setattr(Path, "stat", fail)
    store.check_not_gone()


@pytest.mark.slow
def test_a_sweep_whose_store_vanishes_ends_in_order(
    sweeps_in: Callable[..., Any], smoke_variants: Path, tmp_path: Path
) -> None:
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    sweeps = sweeps_in(tmp_path, WRITES_ON)
    sweep = sweeps.start("scene=motorcycle", "preset=smoke", "seed=0,1")
    end = time.monotonic() + 60
    while not (tmp_path / "begun").exists():
        assert sweep.process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)
    delete(tmp_path / "s")
    code, out, err = sweep.end()
    sweeps.leave_nothing_running()
    assert code == 1, err
    assert err.count("no longer there") == 1, err
    assert "store=s: it is no longer there" in err
    for noise in ("Traceback", "Error", "SIGTERM", "failed"):
        assert noise not in out + err
    assert not (tmp_path / "s").exists()
    assert not list((tmp_path / "tmp").glob("xrgs-*"))
