"""Tests of the summary of a store."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.experiment import identity
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.runtime.progress import Progress
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import ConfinedPath
from xrgs.sweep import inventory, locks
from xrgs.sweep.status import describe, read


def cell(
    store: Store, name: str, code: dict[str, str] | None = None, **changes: object
) -> CellFolder:
    """A cell that was begun, with these changes of its identity; None removes a key."""
    folder = store.cell(name)
    what: dict[str, object] = {"splat": {"backend": "torch"}, "arithmetic": "torch"}
    what["code"] = code or identity.training_code("torch")
    what |= changes
    begin_attempt(
        folder, {"scene": {"name": "statue"}}, {k: v for k, v in what.items() if v is not None}
    )
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
    rows.append(("busy", "statue", "mip"))
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
    assert "1 folder of earlier attempts" in text
    assert "1 variant, 1 sweep" in text
    assert "failed  statue / ?  ended by SIGKILL\n" in text
    (sweep_id,) = store.sweep_ids()
    assert f"busy  statue / mip  sweep {sweep_id}  by process {os.getpid()} on" in text
    assert ": training 20 of 80 steps, 3 steps/s, ~20 s left" in text
    assert "scores.csv is missing or has another size" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["statue", "baseline", "1"] in lines
    assert ["statue", "consistency", "1", "1"] in lines


def test_a_stale_cell_names_the_files_that_are_others_now(store: Store) -> None:
    stale = {cell.id: cell.stale for cell in read(store.path).cells if cell.stale}
    assert stale == {"stale": ("gone.py", "splat/densify.py")}
    text = describe(read(store.path))
    assert "stale: 1 done cell of" in text
    assert "  splat/densify.py: 1 cell" in text


def test_a_cell_of_another_arithmetic_is_stale(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, native = identity.training_code("native"), {"backend": "native"}
    done(store, "fused", code, arithmetic="fma", splat=native)
    done(store, "unfused", code, arithmetic="no-fma", splat=native)
    # As a cell has it that was trained before the arithmetic was part of the identity.
    done(store, "old", code, arithmetic=None, splat=native)
    monkeypatch.setattr(inventory, "arithmetic", lambda _: "fma")
    stale = {cell.id: cell.stale for cell in read(store.path).cells}
    assert stale["fused"] == ()
    assert stale["unfused"] == ("arithmetic (no-fma, here fma)",)
    assert stale["old"] == ("arithmetic (not recorded, here fma)",)

    def missing(_: str) -> str:
        raise XrgsError("not built on this machine")

    monkeypatch.setattr(inventory, "arithmetic", missing)  # where stores are only read
    assert [cell.id for cell in read(store.path).cells if cell.stale] == ["stale"]


@pytest.fixture
def intact(store: Store) -> Store:
    """The store, with nothing in it that is damaged or can't be verified."""
    for name in ("corrupt", "stopped", "failed", "busy"):
        store.cell(name).folder.remove()
    (store.variants / "fa-bb").remove()
    return store


def unreadable(monkeypatch: pytest.MonkeyPatch, name: str, number: int) -> None:
    """Let opening files and folders of a name fail, as for want of permission."""
    real = ConfinedPath._opened, ConfinedPath._open_regular

    def failing(path: ConfinedPath) -> None:
        if path.name == name:
            raise OSError(number, os.strerror(number), str(path))

    def opened(path: ConfinedPath) -> Any:
        failing(path)
        return real[0](path)

    def open_regular(path: ConfinedPath, flags: int) -> int:
        failing(path)
        return real[1](path, flags)

    monkeypatch.setattr(ConfinedPath, "_opened", opened)
    monkeypatch.setattr(ConfinedPath, "_open_regular", open_regular)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ESTALE])
def test_a_cell_that_cannot_be_read_now_is_listed_with_the_reason(
    intact: Store, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    unreadable(monkeypatch, "status.json", number)
    found = read(intact.path)
    assert {cell.state.name for cell in found.cells} == {"unknown"}
    text = describe(found)
    assert "\nunknown:\n" in text
    assert f"good/status.json: {os.strerror(number)}" in text
    cells = intact.cells()
    assert set(cells["state"]) == {"unknown"}
    assert cells["reason"].str.contains(os.strerror(number)).all()


@pytest.mark.parametrize("folder", ["cells", "sweeps", "variants", "locks"])
@pytest.mark.parametrize("kind", ["link", "pipe", "unreadable"])
def test_a_folder_that_cannot_be_listed_is_named_and_hides_no_other(
    intact: Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: str, kind: str
) -> None:
    path = intact.path / folder
    if kind == "unreadable":
        unreadable(monkeypatch, folder, errno.EACCES)
    else:
        path.rename(tmp_path / "elsewhere")
        if kind == "link":
            path.symlink_to(tmp_path / "elsewhere")
        else:
            os.mkfifo(path)
    if folder == "cells" and kind != "unreadable":
        with pytest.raises(XrgsError, match="is not a store"):
            read(intact.path)
        return
    text = describe(read(intact.path))
    assert (f"  {path}: " in text) == (folder != "locks" or kind == "unreadable")
    assert ("3 done" in text) == (folder != "cells")
    assert ("1 sweep recorded" in text) == (folder != "sweeps")


def test_what_is_no_cell_is_named(intact: Store, tmp_path: Path) -> None:
    cells = intact.path / "cells"
    (cells / "dangling").symlink_to(tmp_path / "gone")
    os.mkfifo(cells / "pipe")
    (cells / os.fsdecode(b"\xff\xfe")).mkdir()
    (cells / "\x1b[2J").mkdir()
    (intact.path / "variants" / "a-b").symlink_to(tmp_path)
    (intact.path / "sweeps" / "pipe.json").symlink_to(tmp_path / "gone")
    text = describe(read(intact.path))
    assert "5 cells\n  3 done, 2 corrupt" in text
    assert "dangling  ? / ?  it is a symbolic link" in text
    assert "pipe  ? / ?  it is not a folder" in text
    assert text.count("a cell can't have this name") == 2
    assert f"{intact.path}/variants/a-b: not a folder" in text
    assert f"{intact.path}/sweeps/pipe.json: is a link, which is not followed" in text
    assert text.isprintable() or not set(text) & set("\x1b\udcff")
    assert len(intact.cells()) == 5


def test_the_size_of_folders_that_are_nested_too_deeply_is_unknown(intact: Store) -> None:
    place = os.open(intact.path / "scenes", os.O_RDONLY)
    for _ in range(1500):
        os.mkdir("d", dir_fd=place)
        deeper = os.open("d", os.O_RDONLY, dir_fd=place)
        os.close(place)
        place = deeper
    os.close(place)
    found = read(intact.path)
    assert found.sizes["scenes"] is None
    text = describe(found)
    assert "on disk at least: " in text
    assert "scenes unknown" in text
    assert "folders are nested too deeply" in text
    assert "3 done" in text
    subprocess.run(["/bin/rm", "-rf", str(intact.path / "scenes")], check=True)  # rmtree recurses


def test_links_and_what_they_lead_to_have_no_size(intact: Store, tmp_path: Path) -> None:
    before = read(intact.path).sizes
    (tmp_path / "large").write_bytes(bytes(1_000_000))
    (intact.path / "cells" / "good" / "link").symlink_to(tmp_path / "large")
    (intact.path / "folder").symlink_to(tmp_path)
    assert read(intact.path).sizes == before


def test_it_writes_nothing_and_needs_no_torch(
    run_command: Callable[..., tuple[int, str, str]], store: Store, tmp_path: Path
) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('torch was imported')")
    before = sorted(store.path.rglob("*"))
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    code, out, err = run_command("status", tmp_path, "--store=s", PYTHONPATH=path)
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


def test_names_of_a_store_are_not_obeyed_and_stay_on_their_lines(store: Store) -> None:
    code = identity.training_code("torch") | {"x\x1b]0;t\x07\nstale: no cells": "0"}
    done(store, "evil", code)
    path = store.path.rename(store.path.with_name("s\x1b[2J\nstore s: 99 cells"))
    (path / "folder\x1b[31m\n").mkdir()
    text = describe(read(path))
    assert text.replace("\n", "").isprintable()
    assert [line for line in text.split("\n") if line.startswith(("store", "stale:"))] == [
        f"store {path.parent}/s [2J store s: 99 cells: 8 cells",
        "stale: 2 done cells of other code or arithmetic than here",
    ]


def test_a_long_name_leaves_the_table_its_columns(store: Store) -> None:
    write_json(cell(store, "long").path / "config.json", {"scene": {"name": "x" * 10**6}})
    row = next(line for line in describe(read(store.path)).split("\n") if line.startswith("xxx"))
    assert row.split()[1:] == ["?", "1"]
