"""Tests of the summary of a store."""

from __future__ import annotations

import errno
import os
import pty
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from xrgs.errors import XrgsError
from xrgs.runtime import lease
from xrgs.runtime.progress import Progress
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import walk_files
from xrgs.store import identity, listing
from xrgs.store.store import Store
from xrgs.sweep.status import describe, running


@pytest.fixture
def store(cells: Any) -> Store:
    """A store with a cell of each kind."""
    store: Store = cells.store
    next(store.variants.iterdir()).rename(store.variants / "fa-bb")
    cells.done("good")
    now = identity.training_code("torch")
    cells.done("stale", {"code": now | {"core": "0", "gone": "1"}})
    (cells.done("corrupt").path / "scores.csv").write_text("view\n")
    cells.done("twice")
    cells.done("twice")
    cells.begin("stopped")
    cells.begin("failed").fail("ended by SIGKILL\nand more")
    busy = cells.begin("busy")
    shown = Progress("training", "step", 20, 80, 3.0)
    write_json(busy.progress, msgspec.structs.asdict(shown))
    assert lease.acquire(store.leases, "busy") is not None
    (store.variants / "failed-aa").mkdir()
    cells.record(
        ("good", "statue", "baseline"),
        ("stale", "statue", "consistency"),
        (None, "fern", "x"),
        ("busy", "statue", "mip"),
    )
    return store


def test_every_cell_is_counted_and_told_why(store: Store) -> None:
    text = describe(store.path)
    assert "7 cells" in text
    assert "3 done, 1 running, 1 unfinished, 1 failed, 1 corrupt" in text
    assert "1 folder of earlier attempts" in text
    assert "1 variant, 1 sweep" in text
    assert "failed  motorcycle / ? / seed 0  ended by SIGKILL\n" in text
    (sweep_id,) = store.sweep_ids()
    assert f"busy  statue / mip / seed 0  sweep {sweep_id}  by process {os.getpid()} on" in text
    assert ": training 20 of 80 steps, 3 steps/s, ~20 s left" in text
    assert "scores.csv is missing or has another size" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["statue", "baseline", "1"] in lines
    assert ["statue", "consistency", "1", "1"] in lines
    done = text.partition("done, the latest first:\n")[2].partition("\n\n")[0]
    assert {line.strip() for line in done.splitlines()} == {
        "good  statue / baseline / seed 0",
        "stale  statue / consistency / seed 0",
        "twice  motorcycle / ? / seed 0",
    }
    stale = {cell.id: cell.stale for cell in store.cell_rows() if cell.stale}
    assert stale == {"stale": ("core", "gone")}
    assert "stale: 1 done cell of" in text
    assert "  core: 1 cell" in text


def test_a_cell_of_another_arithmetic_is_stale(
    store: Store, cells: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    native = {"code": identity.training_code("native")}
    native |= {"splat": cells.plan("good").identity().splat | {"backend": "native"}}
    for name, arithmetic in (("fused", "fma"), ("unfused", "no-fma"), ("old", "not recorded")):
        cells.done(name, native | {"arithmetic": arithmetic})
    monkeypatch.setattr(listing, "arithmetic", lambda _: "fma")
    stale = {cell.id: cell.stale for cell in store.cell_rows()}
    assert stale["fused"] == ()
    assert stale["unfused"] == ("arithmetic (no-fma, here fma)",)
    assert stale["old"] == ("arithmetic (not recorded, here fma)",)


@pytest.fixture
def intact(store: Store) -> Store:
    """The store, with nothing in it that is damaged or can't be verified."""
    for name in ("corrupt", "stopped", "failed", "busy"):
        shutil.rmtree(store.cell(name).path)
    (store.variants / "fa-bb").rmdir()
    return store


def test_a_cell_that_cannot_be_read_now_is_listed_with_the_reason(
    intact: Store, unreadable: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    number = errno.ESTALE
    unreadable("status.json", number)
    assert {cell.state.name for cell in intact.cell_rows()} == {"failed"}
    text = describe(intact.path)
    assert "\nfailed:\n" in text
    assert f"good/status.json: {os.strerror(number)}" in text
    cells = intact.cells()
    assert set(cells["state"]) == {"failed"}
    assert cells["reason"].str.contains(os.strerror(number)).all()
    stat = Path.stat

    def failing(path: Path, **given: bool) -> os.stat_result:
        if path.name == "status.json":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return stat(path, **given)

    monkeypatch.setattr(Path, "stat", failing)  # the disk gives no answer at all
    assert all(cell.state().unreadable for cell in intact.cell_folders())


@pytest.mark.parametrize("folder", ["cells", "sweeps", "variants", "locks"])
def test_a_folder_that_cannot_be_listed_is_named_and_hides_no_other(
    intact: Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: str
) -> None:
    path, listed = intact.path / folder, Path.iterdir

    def iterdir(of: Path) -> Iterator[Path]:
        if of == path:
            raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(of))
        return listed(of)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    text = describe(intact.path)
    assert (f"  {path}: " in text) == (folder != "locks")
    assert ("3 done" in text) == (folder != "cells")
    assert ("1 sweep recorded" in text) == (folder != "sweeps")


def test_what_is_no_cell_is_named(intact: Store) -> None:
    cells = intact.path / "cells"
    os.mkfifo(cells / "pipe")
    (cells / os.fsdecode(b"\xff\xfe")).mkdir()
    (cells / "\x1b[2J").mkdir()
    (intact.path / "variants" / "a-b").write_text("")
    (intact.path / "sweeps" / "pipe.json").mkdir()
    text = describe(intact.path)
    assert "4 cells\n  3 done, 1 corrupt" in text
    assert "pipe  ? / ?  it is not a folder" in text
    assert text.count("a cell can't have this name") == 2
    assert f"{intact.path}/variants/a-b: not a folder" in text
    assert f"{intact.path}/sweeps/pipe.json: " in text
    assert text.isprintable() or not set(text) & set("\x1b\udcff")
    assert len(intact.cells()) == 4
    (intact.path / "cells").rename(intact.path / "elsewhere")
    os.mkfifo(intact.path / "cells")
    for path in (intact.path, intact.path / "nowhere"):
        with pytest.raises(XrgsError, match=f"store={path} is not a store"):
            describe(path)


def test_names_of_a_store_are_not_obeyed_and_stay_on_their_lines(store: Store, cells: Any) -> None:
    code = identity.training_code("torch") | {"x\x1b]0;t\x07\nstale: no cells": "0"}
    cells.done("evil", {"code": code})
    path = store.path.rename(store.path.with_name("s\x1b[2J\nstore s: 99 cells"))
    (path / "folder\x1b[31m\n").mkdir()
    text = describe(path)
    assert text.replace("\n", "").isprintable()
    assert [line for line in text.split("\n") if line.startswith(("store", "stale:"))] == [
        f"store {path.parent}/s [2J store s: 99 cells: 8 cells",
        "stale: 2 done cells of other code or arithmetic than here",
    ]


@pytest.mark.slow
def test_a_watch_shows_the_cells_in_training_until_ctrl_c_and_changes_nothing(
    store: Store, tmp_path: Path
) -> None:
    """It needs no torch."""

    def files() -> dict[str, int]:
        return {name: status.st_mtime_ns for name, status in walk_files(store.path)}

    (sweep_id,) = store.sweep_ids()
    clock, *lines = running(store).splitlines()
    assert clock.endswith("  1 cell in training")
    assert lines == [
        f"sweep {sweep_id}: 2 of 4 cells done",
        "  statue / mip / replicate 0/0: training 20 of 80 steps, 3 steps/s, ~20 s left",
    ]
    before = files()
    reader, writer = pty.openpty()
    command = [sys.executable, "-P", "-c", "from xrgs.cli.status import main; main()"]
    (tmp_path / "torch.py").write_text("raise ImportError('torch was imported')")
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    watch = subprocess.Popen(
        [*command, "--store", str(store.path), "--watch"],
        env=os.environ | {"PYTHONPATH": path},
        stdout=writer,
        stderr=writer,
    )
    os.close(writer)
    shown = b""
    while b"training 20 of 80" not in shown:
        shown += os.read(reader, 1 << 16)
    watch.send_signal(signal.SIGINT)
    assert watch.wait(60) == 0
    assert b"Traceback" not in shown
    assert files() == before
    os.close(reader)
