"""A store of unknown origin is reported, or refused by an error that names the file."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.report import build, page
from xrgs.sweep.estimate import RuntimeEstimator
from xrgs.sweep.status import describe, read

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=9)
    | st.sampled_from(["../../x", "/etc/passwd", "..", "a\0b", "\x1b[2J", "\ud800", "x" * 300])
    | st.just(10**400),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=4,
)
FILES = ("sweep", "status", "identity", "summary", "config", "provenance", "scores", "history")


def places(document: Any) -> list[tuple[Any, Any]]:
    """Every value in a document, as its container and its key there."""
    found = []
    for key in list(document) if isinstance(document, dict) else range(len(document)):
        found.append((document, key))
        if isinstance(document[key], (dict, list)):
            found += places(document[key])
    return found


def forge(file: Path, place: int, value: Any) -> None:
    """Replace one value of a .json or .csv file."""
    if file.suffix == ".json":
        document = [json.loads(file.read_text())]
        holder, key = (found := places(document))[place % len(found)]
        holder[key] = value
        file.write_text(json.dumps(document[0]))
    else:
        cells = [line.split(",") for line in file.read_text().splitlines()]
        row = cells[place % len(cells)]
        row[place // 7 % len(row)] = str(value)
        content = "\n".join(",".join(row) for row in cells)
        file.write_bytes(content.encode("utf-8", "surrogatepass"))


def declared(cell: CellFolder) -> None:
    """Update the sizes and hashes in the cell's status to its files as they are now."""
    status = json.loads((cell.path / "status.json").read_text())
    for name in status["files"]:
        content = (cell.path / name).read_bytes()
        status["files"][name] = {
            "bytes": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
        }
    (cell.path / "status.json").write_text(json.dumps(status))


@pytest.fixture
def store(made: Any) -> Store:
    made.add()
    made.add("consistency", factors={"psnr": 1.1})
    made.write()
    kept: Store = made.store
    return kept


@pytest.mark.slow
@given(name=st.sampled_from(FILES), place=st.integers(0, 99), value=VALUES, raw=st.booleans())
@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_content_of_a_store_gives_a_report_or_an_xrgs_error(
    store: Store, monkeypatch: pytest.MonkeyPatch, name: str, place: int, value: Any, raw: bool
) -> None:
    monkeypatch.setattr(page, "draw", lambda *_: [])
    copy = Store(store.path.with_name("copy"))
    shutil.rmtree(copy.path, ignore_errors=True)
    shutil.copytree(store.path, copy.path)
    cell = copy.cell("cell00001")
    suffix = "csv" if name in {"scores", "history"} else "json"
    file = cell.path / f"{name}.{suffix}"
    if name == "sweep":
        file = next((copy.path / "sweeps").iterdir())
    if raw:
        content = file.read_bytes()
        file.write_bytes(content[:place] + repr(value).encode("utf-8", "replace"))
    else:
        forge(file, place, value)
    if name not in {"sweep", "status"}:
        declared(cell)
    looks: tuple[Callable[[], str], ...] = (
        lambda: build(copy.path).text,
        lambda: describe(read(copy.path, verify=True)),
        lambda: copy.cells().to_csv(),
    )
    for look in looks:
        try:
            text = look()
        except XrgsError as error:
            text = str(error)
        assert not set("\x1b\0") & set(text)
    RuntimeEstimator(copy)


@pytest.mark.parametrize("cell_id", ["../cells/cell00001", "..", "/tmp", "a\0"])  # noqa: S108
def test_a_sweep_of_cells_elsewhere_is_refused(store: Store, cell_id: str) -> None:
    file = next((store.path / "sweeps").iterdir())
    record = json.loads(file.read_text())
    for key in ("cell_id", "variant_id"):
        forged = record | {"cells": [record["cells"][0], record["cells"][1] | {key: cell_id}]}
        file.write_text(json.dumps(forged))
        with pytest.raises(StoreError, match=rf"{file.name}: cell 2 "):
            build(store.path)
    with pytest.raises(StoreError, match="is not the id of a"):
        store.cell(cell_id)
    with pytest.raises(StoreError, match="is not the id of a"):
        build(store.path, cell_id)


@pytest.mark.parametrize("name", ["../cell00000/scores.csv", "/etc/passwd", "renders/../a"])
def test_a_cell_of_files_elsewhere_is_corrupt(store: Store, name: str) -> None:
    file = store.cell("cell00001").path / "status.json"
    status = json.loads(file.read_text())
    status["files"][name] = {"bytes": 0, "sha256": ""}
    file.write_text(json.dumps(status))
    state = store.cell("cell00001").state()
    assert state.name == "corrupt"
    assert "is not a file of this cell" in state.reason


def test_links_and_pipes_are_not_read(store: Store) -> None:
    cell, other = store.cell("cell00001"), store.cell("cell00000")
    (cell.path / "scores.csv").unlink()
    (cell.path / "scores.csv").symlink_to(other.path / "scores.csv")
    assert cell.state().name == "corrupt"
    (cell.path / "status.json").unlink()
    os.mkfifo(cell.path / "status.json")
    assert "not a regular file" in cell.state().reason
    (store.cells_folder.path / "link").symlink_to(other.path)
    assert store.cell("link").state().name == "corrupt"
    assert "2 corrupt" in describe(read(store.path))


def test_a_picture_from_elsewhere_is_not_shown(made: Any, tmp_path: Path) -> None:
    made.add(pictures=True)
    cell = made.add("consistency", pictures=True)
    made.write()
    for render in list((cell.path / "renders").iterdir()):
        secret = tmp_path / render.name
        render.rename(secret)
        render.symlink_to(secret)
        declared(cell)
    report = build(made.store.path)
    assert cell.state().name == "corrupt"
    assert not list((report.folder / "figures").iterdir())


def test_a_report_is_not_written_through_links(made: Any, tmp_path: Path) -> None:
    made.add(pictures=True)
    made.add("consistency", pictures=True)
    sweep = made.write()
    folder = build(made.store.path).folder
    precious = tmp_path / "precious"
    precious.write_text("mine")
    for file in [*folder.glob("*.*"), *(folder / "figures").iterdir()]:
        file.unlink()
        file.symlink_to(precious)
    assert len(build(made.store.path).files) == 9
    assert precious.read_text() == "mine"
    shutil.move(folder, tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(XrgsError, match=rf"{sweep} is a link"):
        build(made.store.path)


def test_a_cell_that_goes_on_does_not_write_through_links(store: Store, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    cell = store.cell("going")
    cell.begin({}, {"seed": 0})
    cell.checkpoint.path.write_bytes(b"state")
    (cell.path / "log.txt").symlink_to(precious)
    cell.begin({}, {"seed": 0})
    assert cell.checkpoint.read_bytes() == b"state"
    assert not (cell.path / "log.txt").exists()
    assert precious.read_text() == "mine"
