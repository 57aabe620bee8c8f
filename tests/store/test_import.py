"""The border of a store: a store of somebody else is imported whole, or left out and named."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.store.cells import finished, identity, row, write_variant
from xrgs.errors import StoreError
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import list_names
from xrgs.safeio.hashing import digest, file_digest
from xrgs.store import archive
from xrgs.store.archive import Copied, import_store, pack
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_id
from xrgs.store.store import Store

SCENE = "fedcba9876543210"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store with a done cell, its variant, a rendered scene and the record of a sweep."""
    store = Store(tmp_path_factory.mktemp("original") / "xrgs-store")
    store.prepare()
    what = identity(0, write_variant(store.variants))
    finished(store.cell(cell_id(what)), what=what)
    scene = store.scenes / SCENE
    scene.mkdir()
    (scene / "v0.png").write_bytes(b"image")
    content = {"fingerprint": SCENE, "files": {"v0.png": file_digest(scene / "v0.png")}}
    write_json(scene / "scene.json", content)
    store.write_sweep(["a"], [row(cell_id(what))])
    return store


@pytest.fixture
def foreign(original: Store, tmp_path: Path) -> Store:
    """A copy of that store, to be damaged."""
    shutil.copytree(original.path, tmp_path / "xrgs-store")
    return Store(tmp_path / "xrgs-store")


@pytest.fixture
def mine(tmp_path: Path) -> Store:
    return Store(tmp_path / "mine")


def the_cell(store: Store) -> CellFolder:
    (cell,) = store.cell_folders()
    return cell


def contents(store: Store) -> dict[str, bytes]:
    files = (path for path in store.path.rglob("*") if path.is_file() or path.is_symlink())
    return {str(path.relative_to(store.path)): path.read_bytes() for path in files}


def packed_as(store: Store, file: Path, mode: Any) -> Path:
    with tarfile.open(file, mode) as stream:
        stream.add(store.path, "." if mode == "w" else "xrgs-store")
    return file


@pytest.mark.parametrize("kind", ["folder", "around", ".tar", ".tar.xz"])
def test_a_store_is_imported_whole(foreign: Store, mine: Store, kind: str) -> None:
    cell = the_cell(foreign)
    expected = contents(foreign)
    del expected[f"cells/{cell.id}/log.txt"]
    for name in ("checkpoint.npz", "progress.json"):
        (cell.path / name).write_text("not imported")
    of_the_system = (f"cells/{cell.id}/renders/.DS_Store", f"scenes/{SCENE}/._v0.png")
    parts = ("hydra/a/b.yaml", "reports/x/report.html", "locks/a.0", "cells/a.aside-1/log.txt")
    for name in (*parts, *of_the_system):
        (foreign.path / name).parent.mkdir(parents=True, exist_ok=True)
        (foreign.path / name).write_text("not imported")
    source = foreign.path
    if kind == "around":
        source = foreign.path.parent / "around"
        source.mkdir()
        foreign.path.rename(source / "xrgs-store")
    elif kind != "folder":
        mode = {".tar": "w"}.get(kind, f"w:{kind[5:]}")
        source = packed_as(foreign, foreign.path.parent / f"a{kind}", mode)
    found = import_store(source, mine)
    assert found == Copied(1, 1, 1, 1, ())
    assert str(found) == "1 cell, 1 variant, 1 rendered scene, 1 record of sweeps"
    assert contents(mine) == expected
    assert import_store(source, mine) == Copied(0, 0, 0, 0, (), present=4)
    assert contents(mine) == expected


def test_what_was_packed_is_imported_and_there_is_no_second_one(
    foreign: Store, mine: Store, tmp_path: Path
) -> None:
    pack(foreign, foreign.cell_folders(), tmp_path / "a.tar.xz", tmp_path)
    assert import_store(tmp_path / "a.tar.xz", mine) == Copied(1, 1, 0, 1, ())
    (variant,) = list_names(mine.variants)
    assert variant.startswith("trimmed-")
    assert mine.sweep_record().cells == foreign.sweep_record().cells
    # The variant with its images is the same one, and what is mine is left as it is.
    assert import_store(foreign.path, mine) == Copied(0, 0, 1, 0, (), present=3)
    assert list_names(mine.variants) == [variant]


# What a file of the store may be instead


def change(file: Path) -> str:
    content = file.read_bytes()
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    return "changed"


def test_cells_with_other_files_are_left_out(foreign: Store, mine: Store) -> None:
    cell = the_cell(foreign)
    scores, identity_file, splats = (
        cell.path / name for name in ("scores.csv", "identity.json", "splats.ply")
    )
    elsewhere = foreign.path / ".elsewhere"

    def left_out(*why: str) -> None:
        found = import_store(foreign.path, mine)
        assert found.cells == 0
        (line,) = found.left_out
        assert line.startswith(f"cells/{cell.id}: ")
        assert all(part in line for part in why)
        assert list_names(mine.cells_folder) == []

    change(scores)
    left_out("scores.csv", "changed")
    change(scores)  # back again
    scores.rename(elsewhere)
    scores.symlink_to(elsewhere)
    left_out("scores.csv", "not a regular file")
    scores.unlink()
    left_out("scores.csv is missing")
    elsewhere.rename(scores)
    splats.rename(elsewhere)
    os.mkfifo(splats)
    left_out("splats.ply", "not a regular file")
    splats.unlink()
    elsewhere.rename(splats)
    (cell.path / "renders" / "c.png").write_bytes(b"more")
    (cell.path / "extra.py").write_text("more")
    left_out("extra.py: it does not belong there", "renders/c.png: it does not belong there")
    (cell.path / "renders" / "c.png").unlink()
    (cell.path / "extra.py").unlink()
    identity_file.write_text(identity_file.read_text().replace('"seed": 0', '"seed": 1'))
    seal(cell)
    left_out(
        "identity.json: its digest is not the id of the cell: the file has changed, or the cell"
    )


SCENE_CONF = b'{"name": "", "kind": "folder", "path": "x", "views": 2}'
BILLION = b"[" + b"[[]]," * 700_000 + b"[]]"


@pytest.mark.parametrize(
    ("file", "content", "why"),
    [
        ("status.json", b'{"state": "failed", "reason": "x"}', "the cell is failed, not done: x"),
        ("status.json", b"[" * 1_000_000, "not valid JSON|Expected `object`"),
        ("status.json", b'{"state": "done", "files": {"../x": {"bytes": 1}}}', "key in files"),
        ("status.json", b'{"state": "done"}', r"config\.json is not listed"),
        ("identity.json", b'{"variant": "../v"}', "identity.json: variant: not a name"),
        ("identity.json", BILLION, "identity.json: the file: Expected `object`"),
        ("summary.json", b'{"training_time_s": 1e99}', "summary.json: training_time_s"),
        ("config.json", b'{"scene": %s, "seed": "0"}' % SCENE_CONF, "config.json: seed"),
        ("scores.csv", b"view,psnr\n../a,3\n", "scores.csv"),
        ("history.csv", b"step,step\n1,1\n", "history.csv: the header"),
    ],
)
def test_a_cell_with_a_damaged_file_is_left_out(
    foreign: Store, mine: Store, file: str, content: bytes, why: str
) -> None:
    """Its status has the right hash of the file."""
    cell = the_cell(foreign)
    (cell.path / file).write_bytes(content)
    if file != "status.json":
        seal(cell)
    found = import_store(foreign.path, mine)
    (line,) = found.left_out
    assert line.startswith(f"cells/{cell.id}: ")
    assert found.cells == 0
    assert re.search(why, line)


def seal(cell: CellFolder) -> None:
    """Let a cell's status list its files as they are now."""
    cell.finish(["a", "b"], {})


def test_a_component_that_a_config_names_is_not_imported(
    foreign: Store, mine: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_plugin.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    cell = the_cell(foreign)
    config = json.loads((cell.path / "config.json").read_text())
    config["components"]["plugins"] = {"evil_plugin": {"_target_": "evil_plugin.x"}}
    write_json(cell.path / "config.json", config)
    seal(cell)
    assert import_store(foreign.path, mine).cells == 1


def change_manifest(store: Store, **changes: Any) -> None:
    (name,) = list_names(store.variants)
    file = store.variants / name / "variant.json"
    content = json.loads(file.read_text()) | changes
    hashed = {k: v for k, v in content.items() if k not in ("id", "scene", "code")}
    content["id"] = f"{content['key']}-{digest(hashed)}"
    write_json(file, content)
    file.parent.rename(store.variants / content["id"])


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"factor": 0}, "factor"),
        ({"files": {"../../x": "0"}}, "files"),
    ],
)
def test_a_variant_with_a_damaged_manifest_is_left_out(
    foreign: Store, mine: Store, changes: dict[str, Any], why: str
) -> None:
    change_manifest(foreign, **changes)
    found = import_store(foreign.path, mine)
    assert found.variants == 0
    assert why in found.left_out[0]
    assert list_names(mine.variants) == []


def test_a_variant_or_a_scene_with_other_files_or_another_name_is_left_out(
    foreign: Store, mine: Store
) -> None:
    (variant,) = list_names(foreign.variants)
    change(foreign.variants / variant / "images/train/a.png")
    (foreign.scenes / SCENE).rename(foreign.scenes / ("0" * 16))
    other, scene = import_store(foreign.path, mine).left_out
    assert other == f"variants/{variant}: images/train/a.png: it has changed since it was written"
    assert "its fingerprint is not the name of its folder" in scene
    (foreign.variants / variant).rename(foreign.variants / f"{'0' * 16}-{'1' * 16}")
    assert "another name than its variant" in import_store(foreign.path, mine).left_out[0]


def test_a_record_that_has_changed_or_is_of_no_type_is_left_out(
    foreign: Store, call_command: Callable[..., tuple[int, str, str]]
) -> None:
    (sweep_id,) = foreign.sweep_ids()
    file = foreign.sweeps / f"{sweep_id}.json"
    file.write_text(file.read_text().replace('"baseline"', '"best"'))
    (foreign.sweeps / ("0" * 16 + ".json")).write_text('{"version": 1, "command": 3}')
    code, out, err = call_command("store", "import", str(foreign.path), "--store", "mine")
    assert code == 1
    said = out + err
    assert said.count("imported: 1 cell, 1 variant, 1 rendered scene, 0 records") == 1
    assert "command: Expected `array`" in said
    assert "its cells have changed" in said


# What only archives can have


def archive_of(folder: Path, *members: tuple[tarfile.TarInfo | str, bytes]) -> Path:
    with tarfile.open(folder / "a.tar", "w") as stream:
        for member, content in members:
            header = tarfile.TarInfo(member) if isinstance(member, str) else member
            header.size = len(content)
            stream.addfile(header, io.BytesIO(content))
    return folder / "a.tar"


def test_a_name_that_no_store_has_is_left_out(mine: Store, tmp_path: Path) -> None:
    names = ("cells/0123456789ABCDEF/status.json", "variants/x/variant.json", "sweeps/x.json")
    lines = import_store(archive_of(tmp_path, *((name, b"{}") for name in names)), mine).left_out
    (line,) = lines
    assert line.endswith(": no store has anything of this name")
    assert all("/".join(name.split("/")[:2]) in line for name in names)
    assert contents(mine) == {}


@pytest.mark.parametrize("name", ["../x", "cells/0123456789abcdef/../../../x"])
def test_an_archive_with_a_name_outside_its_folder_is_refused(
    mine: Store, tmp_path: Path, name: str
) -> None:
    source = archive_of(tmp_path, ("cells/0123456789abcdef/status.json", b"{}"), (name, b"{}"))
    before = {path for path in tmp_path.rglob("*") if not path.is_relative_to(mine.path)}
    with pytest.raises(StoreError, match="outside the destination"):
        import_store(source, mine)
    assert contents(mine) == {}
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(mine.path)} == before


@pytest.mark.parametrize(
    ("kind", "target"),
    [
        (tarfile.SYMTYPE, "/etc/passwd"),
        (tarfile.LNKTYPE, "cells/0123456789abcdef/config.json"),
        (tarfile.FIFOTYPE, ""),
    ],
)
def test_an_archive_with_a_link_or_a_device_is_refused(
    mine: Store, tmp_path: Path, kind: bytes, target: str
) -> None:
    header = tarfile.TarInfo("cells/0123456789abcdef/status.json")
    header.type, header.linkname = kind, target
    with pytest.raises(StoreError, match=r"a\.tar: not an archive of a store \("):
        import_store(archive_of(tmp_path, (header, b"")), mine)
    assert contents(mine) == {}


@pytest.mark.parametrize("content", [b"", b"x" * 2000, b"\x1f\x8b\x08", b"BZh9xxxx"])
def test_what_is_no_archive_is_named(mine: Store, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.tar").write_bytes(content)
    with pytest.raises(StoreError, match=r"a\.tar: not an archive of a store \([^\n]*\)$"):
        import_store(tmp_path / "a.tar", mine)


def test_a_source_that_is_not_there_makes_no_store(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    new = Store(tmp_path / "new")
    for name, message in (("nothing", "No such file"), ("photographs", "not a store: it has no")):
        with pytest.raises(StoreError, match=f"{name}: {message}"):
            import_store(tmp_path / name, new)
    assert not new.path.exists()


def test_an_archive_that_breaks_off_is_refused(foreign: Store, mine: Store, tmp_path: Path) -> None:
    """The random bytes at its end do not fit into what was compressed before."""
    (foreign.path / "zzz").write_bytes(os.urandom(1 << 18))
    source = packed_as(foreign, tmp_path / "a.tar", "w:xz")
    os.truncate(source, source.stat().st_size - 100_000)
    with pytest.raises(StoreError, match=r"a\.tar: not an archive of a store \("):
        import_store(source, mine)
    assert contents(mine) == {}


def test_what_is_no_store_is_refused(mine: Store, tmp_path: Path) -> None:
    (tmp_path / "folder" / "photographs").mkdir(parents=True)
    for source in (tmp_path / "folder", archive_of(tmp_path, ("x/y", b"1"))):
        with pytest.raises(StoreError, match="not a store: it has no folder variants, scenes, "):
            import_store(source, mine)


# Interruptions


@pytest.mark.parametrize("name", ["_check", "copy_all", "_copy"])
def test_a_stopped_import_shows_nothing_that_is_not_whole_and_goes_on(
    foreign: Store, mine: Store, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill leaves the hidden folders, and the lease of a process that is no more."""
    real, calls = getattr(archive._Import, name), []

    def killed(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 2 or name == "copy_all":
            raise KeyboardInterrupt
        return real(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(archive._Import, name, killed)
        patch.setattr(archive._Import, "clear", lambda _: None)
        with pytest.raises(KeyboardInterrupt):
            import_store(foreign.path, mine)
    assert [cell.state().name for cell in mine.cell_folders()] in ([], ["done"])
    before = len([*mine.cell_folders(), *mine.sweep_ids()])
    shown = [*list_names(mine.variants), *list_names(mine.scenes)]
    before += len([name for name in shown if not name.startswith(".")])
    assert before == (1 if name in {"_check", "_copy"} else 0)
    assert import_store(foreign.path, mine).present == before
    expected = contents(foreign)
    assert contents(mine) == {k: v for k, v in expected.items() if not k.endswith("log.txt")}


def test_a_cell_that_a_sweep_begins_meanwhile_is_the_sweeps(
    foreign: Store, mine: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = mine.cell(the_cell(foreign).id)

    def begun(importing: archive._Import, item: Path) -> bool:
        if item.name == cell.id:
            cell.path.mkdir()
            (cell.path / "log.txt").touch()
        return real(importing, item)

    real = archive._Import._copy
    monkeypatch.setattr(archive._Import, "_copy", begun)
    assert import_store(foreign.path, mine) == Copied(0, 1, 1, 1, (), present=1)
    assert list_names(cell.path) == ["log.txt"]
