"""A store of unknown origin is reported, or refused by an error that names the file."""

from __future__ import annotations

import errno
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
from xrgs.experiment import verification
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.report import build, page, pictures
from xrgs.safeio.confined import ConfinedPath
from xrgs.sweep.estimate import CostEstimator
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
        lambda: describe(read(copy.path)),
        lambda: verification.describe(verification.verify(copy)),
        lambda: copy.cells().to_csv(),
    )
    for look in looks:
        try:
            text = look()
        except XrgsError as error:
            text = str(error)
        assert not set("\x1b\0") & set(text)
    CostEstimator(copy)


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
    assert len(build(made.store.path).files) == 13
    assert precious.read_text() == "mine"
    for place in (folder / "figures", folder, folder.parent):
        elsewhere = tmp_path / "elsewhere" / place.name
        shutil.copytree(place, elsewhere)
        shutil.rmtree(place)
        place.symlink_to(elsewhere)
        before = {file: file.lstat().st_mtime_ns for file in elsewhere.rglob("*")}
        with pytest.raises(XrgsError, match=rf"{place} is a link.*remove it, or name another"):
            build(made.store.path, sweep)
        assert {file: file.lstat().st_mtime_ns for file in elsewhere.rglob("*")} == before
        place.unlink()
        shutil.copytree(elsewhere, place)


def test_the_folder_that_a_user_names_may_be_a_link(store: Store, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    build(store.path, out=tmp_path / "link")
    assert (tmp_path / "mine" / "table.md").is_file()


def test_a_cell_that_cannot_be_read_now_is_a_row_with_the_reason(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = ConfinedPath._open_regular

    def failing(path: ConfinedPath, flags: int) -> int:
        if path.parts[1:] == ("cell00001", "summary.json"):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return real(path, flags)

    monkeypatch.setattr(ConfinedPath, "_open_regular", failing)
    report = build(store.path)
    page = (report.folder / "table.md").read_text()
    for text in (report.text, page):
        assert "1 cell can't be read now: run the report again" in text.replace("\\", "")
    (row,) = [line for line in report.text.splitlines() if "unknown" in line]
    assert "summary.json: " in row
    assert os.strerror(errno.EIO) in row
    state = store.cells().set_index("cell_id")["state"]
    assert state.to_dict() == {"cell00000": "done", "cell00001": "unknown"}


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("identity.json", '{"protocol": 1e30, "variant": "v", "seed": 0}', "protocol=1e+30"),
        ("identity.json", '{"protocol": 1, "variant": "v", "seed": %s}' % 10**400, "seed=1000"),
        ("summary.json", '{"gaussians": 1e308}', "out of range"),
        ("summary.json", '{"gaussians": [1]}', "not a number"),
        ("scores.csv", "view,psnr\na,1e308\nb,1e308\n", "1e+308 is out of range"),
        ("scores.csv", "view,psnr\na,1\na,1\n", "a view has two rows"),
        ("history.csv", "step,loss,gaussians,split\n0,0,1,1e308\n", "1e+308 is out of range"),
        ("history.csv", "step,loss,gaussians,split\n0,0,1,abc\n", "abc"),
        ("history.csv", "step\n" + "0\n" * 2_200_000, "4400005 bytes"),
        ("history.csv", "step\n" + "0\n" * 20_001, "more than 20000 rows"),
        ("history.csv", ",".join(map(str, range(1001))) + "\n", "1000 columns"),
        ("provenance.json", "[]", "provenance.json: not a JSON object"),
        ("status.json", "null", "status.json: not a JSON object"),
        ("status.json", '{"state": "done", "files": 1}', "status.json: it is malformed"),
    ],
)
def test_a_file_that_is_not_what_it_should_be_costs_its_cell_alone(
    store: Store, name: str, content: str, reason: str
) -> None:
    cell = store.cell("cell00001")
    (cell.path / name).write_text(content)
    if name != "status.json":
        declared(cell)
        status = json.loads((cell.path / "status.json").read_text())
        if name == "scores.csv":
            status["views"] = [line.split(",")[0] for line in content.splitlines()[1:]]
            (cell.path / "status.json").write_text(json.dumps(status))
    report = build(store.path)
    (row,) = [line for line in report.text.splitlines() if " corrupt " in line]
    assert reason in row
    cells = (report.folder / "cells.csv").read_text().splitlines()
    assert sum(",done," in line for line in cells) == 1
    assert len(store.cells()) == 2


@pytest.mark.parametrize("value", ["inf", "-inf", "nan", "1e30", "-1e30", "1e-320", "0"])
def test_extreme_numbers_are_reported_without_a_warning(store: Store, value: str) -> None:
    for number, name in enumerate(("cell00000", "cell00001")):
        cell = store.cell(name)
        row = ",".join([value] * 3)
        (cell.path / "scores.csv").write_text(f"view,psnr,ssim,lpips\na,{row}\nb,{row}\n")
        rows = "".join(f"{step},{value},{value},{value}\n" for step in range(2 + number))
        (cell.path / "history.csv").write_text(f"step,loss,gaussians,mip.value\n{rows}")
        declared(cell)
        status = json.loads((cell.path / "status.json").read_text()) | {"views": ["a", "b"]}
        (cell.path / "status.json").write_text(json.dumps(status))
    assert (build(store.path).folder / "table.md").is_file()
    assert set(store.cells()["state"]) == {"done"}


def test_a_damaged_newest_record_is_named_and_the_one_before_is_taken(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    (good,) = store.sweep_ids()
    sweeps = store.path / "sweeps"
    os.mkfifo(sweeps / "pipe.json")
    (sweeps / "link.json").symlink_to(sweeps / "gone")
    (sweeps / "text.json").write_text("{")
    for name in ("pipe", "link", "text"):
        os.utime(sweeps / f"{name}.json", ns=(2**62, 2**62), follow_symlinks=False)
    assert build(store.path).folder.name == good
    lines = capsys.readouterr().err.splitlines()
    for name in ("pipe", "link", "text"):
        (line,) = [line for line in lines if f"sweeps/{name}.json: " in line]
        assert line.endswith("; the sweep before it is taken")
    assert len(store.cells()) == 2
    (sweeps / f"{good}.json").unlink()
    with pytest.raises(StoreError, match=r"sweeps/text\.json: "):
        build(store.path)


def test_of_many_pictures_the_first_are_drawn_and_the_rest_said(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "_MAX_PICTURES", 3)
    made.add()
    for label in ("a", "b", "c"):
        made.add(label, pictures=True)
    made.write()

    def drawn(names: list[str] | None = None) -> tuple[str, set[str]]:
        shutil.rmtree(made.store.path / "reports", ignore_errors=True)
        report = build(made.store.path, pictures=names)
        files = {file.stem for file in (report.folder / "figures").iterdir()}
        return (report.folder / "table.md").read_text(), files

    page, files = drawn()
    assert files == {"trade-off", "fern--a--training"}  # the baseline has no renders to show
    assert "No picture of 4 more: only the first 3 are drawn; --pictures NAMES draws others" in page
    page, files = drawn(["fern--b--training", "fern--c--training", "trade-off", "fern--b"])
    assert files == {"fern--b--training", "fern--c--training", "trade-off"}
    assert "only the first" not in page


def test_a_cell_that_goes_on_does_not_write_through_links(store: Store, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    cell = store.cell("going")
    begin_attempt(cell, {}, {"seed": 0})
    cell.checkpoint.path.write_bytes(b"state")
    (cell.path / "log.txt").symlink_to(precious)
    begin_attempt(cell, {}, {"seed": 0})
    assert cell.checkpoint.read_bytes() == b"state"
    assert not (cell.path / "log.txt").exists()
    assert precious.read_text() == "mine"
