"""Tests of `xrgs-store`; what it lists and removes has tests of its own."""

from __future__ import annotations

import io
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cli.conftest import finish
from xrgs.config import Conf
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_identity
from xrgs.store.schema import RecordedCell
from xrgs.store.store import Store

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def begun(tmp_path: Path, compose: Callable[..., Conf]) -> Callable[[str, int], CellFolder]:
    """(id, steps) -> the folder of a cell whose training has begun."""

    def begin(name: str, steps: int) -> CellFolder:
        folder = Store(tmp_path / "s").cell(name)
        conf = compose(f"train.steps={steps}")
        plan_cell(folder, conf, cell_identity(conf, "v"))
        begin_attempt(folder)
        return folder

    return begin


@pytest.fixture
def xrgs_store(call_command: Call, tmp_path: Path, begun: Callable[[str, int], CellFolder]) -> Call:
    """(*arguments) -> exit code, stdout and stderr of `xrgs-store` on a store of two cells."""
    store = Store(tmp_path / "s")
    store.prepare()
    for name, steps in (("abc", 3), ("abd", 4)):
        folder = begun(name, steps)
        (folder.path / "splats.ply").write_bytes(bytes(1000))
        finish(folder, gaussians=17)
    names = (("abc", "baseline"), ("abd", "mip"))
    rows = [RecordedCell(name, label, "", "fern", 0, 0, "v", "abc") for name, label in names]
    store.write_sweep([], rows)

    def run(*arguments: str) -> tuple[int, str, str]:
        return call_command("store", *arguments, "--store", "s")

    return run


def cells(tmp_path: Path) -> list[str]:
    return sorted(path.name for path in (tmp_path / "s" / "cells").iterdir())


def test_cells_are_listed_and_one_is_shown(xrgs_store: Call) -> None:
    code, out, _ = xrgs_store("list", "--ablations", "mip")
    assert code == 0
    assert out.startswith("1 cell, ")
    assert "abd   fern   mip" in out
    code, out, _ = xrgs_store("show", "abd")
    assert code == 0
    assert "differs from its baseline abc in:\n  train.steps: 3 -> 4\n" in out
    assert "psnr: 21 dB" in out
    assert "gaussians: 17" in out
    assert "splats.ply  1 kB" in out


def test_nothing_is_removed_without_a_yes(
    xrgs_store: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = xrgs_store("rm", "abd", "--dry-run")
    assert code == 0
    assert "to remove: cells (1): " in out
    assert "abd  fern / mip / seed 0, done" in out
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))  # no terminal: nobody has answered
    code, _, err = xrgs_store("rm", "abd")
    assert code == 1
    assert "nothing was done; --yes" in err
    assert cells(tmp_path) == ["abc", "abd"]
    code, out, _ = xrgs_store("rm", "abd", "--yes")
    assert code == 0
    assert "freed " in out
    assert cells(tmp_path) == ["abc"]


@pytest.mark.parametrize(("answer", "left"), [("y\n", []), ("", ["abd"])])
def test_a_terminal_is_asked(
    xrgs_store: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, left: list[str]
) -> None:
    terminal = io.StringIO(answer)
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdin", terminal)
    assert xrgs_store("rm", "abd")[0] == bool(left)
    assert cells(tmp_path) == ["abc", *left]


def test_trim_keeps_what_tables_are_made_of(xrgs_store: Call, tmp_path: Path) -> None:
    code, out, _ = xrgs_store("trim", "--yes")
    assert code == 0
    assert out.splitlines()[-1] == "freed 2 kB"
    assert "done (trimmed)" in xrgs_store("list")[1]
    assert "removed by xrgs-store trim: 1 files" in xrgs_store("show", "abc")[1]
    assert len(Store(tmp_path / "s").cells()) == 2
    assert xrgs_store("check")[0] == 0


def test_packed_cells_are_a_store_again(
    xrgs_store: Call, tmp_path: Path, begun: Callable[[str, int], CellFolder]
) -> None:
    begun("abe", 5)
    code, _, err = xrgs_store("pack", "--out", "study.zip")
    assert code == 1
    assert "--out study.zip: name the archive to write, FILE.tar.xz" in err
    code, out, _ = xrgs_store("pack", "--out", "study.tar.xz")
    assert code == 1  # their variant is not there
    assert out.startswith("study.tar.xz: 2 cells, 0 variants, 1 record of sweeps; ")
    assert out.splitlines()[1] == "left out, not done: 1 cell"
    with tarfile.open(tmp_path / "study.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    store = Store(tmp_path / "xrgs-store")
    assert [(cell.id, cell.state().name) for cell in store.cell_folders()] == [
        ("abc", "done"),
        ("abd", "done"),
    ]


def test_check_ends_with_1_where_something_is_damaged(xrgs_store: Call, tmp_path: Path) -> None:
    assert xrgs_store("check")[0] == 0
    (tmp_path / "s" / "cells" / "abc" / "splats.ply").write_bytes(bytes(999) + b"1")
    code, out, _ = xrgs_store("check")
    assert code == 1
    assert "abc/splats.ply: it has changed" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rm", "--yes"], "rm: name cells, or choose them by an option"),
        (["rm", "ab", "--yes"], "ab: several cells have such an id"),
        (["rm", "--scenes", "horns", "--yes"], "--scenes horns: no cell has that"),
        (["gc", "--of", "cells", "--yes"], "--of cells: choose from: old_code"),
    ],
)
def test_bad_input_is_named_and_removes_nothing(
    xrgs_store: Call, tmp_path: Path, arguments: list[str], message: str
) -> None:
    code, _, err = xrgs_store(*arguments)
    assert code == 1
    assert message in err
    assert cells(tmp_path) == ["abc", "abd"]


@pytest.mark.slow
def test_a_score_on_request_says_what_it_lacks(call_command: Call, store: Path) -> None:
    code, out, _ = call_command("store", "rescore", "--store", str(store), "--also", "lpips_vgg")
    assert code == 1
    assert "fetch the weights with `xrgs-data lpips --network vgg`" in out
    code, _, err = call_command("store", "rescore", "--store", str(store), "--also", "nice")
    assert code == 1
    assert "--also nice: choose from: lpips_vgg" in err


@pytest.mark.parametrize("amount", ["--older-days=-7", "--larger-mb=-1", "--larger-mb=nan"])
def test_an_amount_below_0_chooses_no_cell(xrgs_store: Call, tmp_path: Path, amount: str) -> None:
    """In `find -mtime -7` it means younger than 7 days; here it was true of every cell."""
    code, out, err = xrgs_store("rm", "--yes", amount)
    assert (code, out) == (1, "")
    assert f"{amount.partition('=')[0]} " in err
    assert "must be finite and at least 0" in err
    assert cells(tmp_path) == ["abc", "abd"]


def test_an_archive_without_a_cell_is_not_written(
    xrgs_store: Call, tmp_path: Path, begun: Callable[[str, int], CellFolder]
) -> None:
    begun("abe", 5)
    code, out, err = xrgs_store("pack", "abe", "--out", "study.tar.xz")
    assert (code, out) == (1, "")
    assert "pack: none of the chosen cells is done" in err
    assert not (tmp_path / "study.tar.xz").exists()


def test_replicates_of_a_cell_have_different_names(xrgs_store: Call, tmp_path: Path) -> None:
    store = Store(tmp_path / "s")
    rows = [RecordedCell(n, "mip", "", "fern", d, 0, "v", "a") for n, d in (("abc", 0), ("abd", 2))]
    store.write_sweep([], rows)
    _, out, _ = xrgs_store("trim", "--dry-run")
    assert "  abc  fern / mip / seed 0  " in out
    assert "  abd  fern / mip / variant.seed 2 / seed 0  " in out
