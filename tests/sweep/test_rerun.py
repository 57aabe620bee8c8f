"""A cell trained again from its folder: the same numbers, or what differs."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.experiment.store import CellFolder
from xrgs.safeio.atomic import write_json
from xrgs.sweep.jobs import worker
from xrgs.sweep.rerun import RerunResult, rerun
from xrgs.sweep.status import read

#: As `tests.conftest.run_command` gives it.
RunCommand = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def trained(run_command: RunCommand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the smallest cell, in a store `s`."""
    folder = tmp_path_factory.mktemp("trained")
    smallest = ("scene=motorcycle", "preset=smoke", "train.steps=2", "threads=1", "store=s")
    code, _, err = run_command("sweep", folder, *smallest)
    assert code == 0, err
    return next((folder / "s" / "cells").iterdir())


@pytest.fixture
def cell(trained: Path, tmp_path: Path) -> CellFolder:
    """A copy of it in a store of its own, without its variant's images."""
    copied = tmp_path / "s" / "cells" / trained.name
    shutil.copytree(trained, copied)
    variant = CellFolder(trained).identity()["variant"]
    (tmp_path / "s" / "variants" / variant).mkdir(parents=True)
    return CellFolder(copied)


@pytest.fixture
def train(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """(file, old, new, ...) -> stand in for the training: what it gives has these changes."""

    def fake(*changes: tuple[str, str, str]) -> None:
        def run(job: str, request: Mapping[str, Any]) -> dict[str, Any]:
            assert job == "cell"
            folder = CellFolder(Path(request["cell"]))
            for name in ("scores.csv", "history.csv", "splats.ply", "summary.json"):
                shutil.copy(trained / name, folder.path)
            for name, old, new in changes:
                file = folder.path / name
                file.write_text(file.read_text().replace(old, new, 1))
            folder.finish([], 1)
            return {}

        monkeypatch.setattr(worker, "run_in_child", run)

    return fake


def test_the_same_program_gives_the_same_bits(run_command: RunCommand, trained: Path) -> None:
    before = {file: file.stat().st_mtime_ns for file in trained.rglob("*")}
    store = trained.parent.parent
    code, out, err = run_command("sweep", store.parent, f"rerun={trained}")
    assert code == 0, out + err
    assert out.startswith("the same, bit for bit: scores.csv, history.csv, splats.ply")
    assert "nothing differs" in err
    again = trained.with_name(f"{trained.name}.rerun-1")
    assert f"Written to {again}" in out
    assert (again / "splats.ply").read_bytes() == (trained / "splats.ply").read_bytes()
    assert {file: file.stat().st_mtime_ns for file in trained.rglob("*")} == before
    assert [seen.id for seen in read(store).cells] == [trained.name]
    shutil.rmtree(again)


def test_other_numbers_are_told(cell: CellFolder, train: Callable[..., None]) -> None:
    gaussians = cell.summary()["gaussians"]
    train(("summary.json", f'"gaussians": {gaussians}', '"gaussians": 12345'))
    again = rerun(cell.path)
    assert again.differences == [f"gaussians: {gaussians:,} -> 12,345"]
    assert str(again).startswith("not the same numbers\nwhat differs in what it gave:\n  gaussians")


def test_scores_that_somebody_changed_are_told(
    cell: CellFolder, train: Callable[..., None]
) -> None:
    scores = cell.path / "scores.csv"
    header, first, *others = scores.read_text().splitlines()
    left, _, psnr = first.rpartition(",")
    changed = f"{left},{float(psnr) + 0.25}"
    scores.write_text("\n".join([header, changed, *others]) + "\n")
    train()
    again = rerun(cell.path)
    assert again.before == ["the folder: corrupt: scores.csv has changed since the cell finished"]
    assert again.differences == [
        "psnr: differs in 1 views, by at most 0.25",
        "scores.csv: other bytes",
    ]


def test_scores_of_other_views_and_metrics_are_told(
    cell: CellFolder, train: Callable[..., None]
) -> None:
    train(("scores.csv", "motorcycle_left", "another"), ("scores.csv", "lpips", "dists"))
    told = "\n".join(rerun(cell.path).differences)
    assert "scores.csv: only one has another, motorcycle_left" in told


def test_what_the_folder_has_lost_is_told(cell: CellFolder, train: Callable[..., None]) -> None:
    for name in ("scores.csv", "summary.json", "splats.ply"):
        (cell.path / name).unlink()
    train()
    told = "\n".join(rerun(cell.path).differences)
    assert "scores.csv: only one has motorcycle_left, motorcycle_right" in told
    assert "steps: None -> 2" in told
    assert "splats.ply: not in" in told


def test_a_metric_that_one_of_them_has_not(cell: CellFolder, train: Callable[..., None]) -> None:
    train(("scores.csv", ",,", ",0.5,"))  # LPIPS has no weights in tests
    assert "lpips: differs in 1 views, and one of the two has none" in rerun(cell.path).differences


def test_an_identity_that_somebody_changed_is_told(
    cell: CellFolder, train: Callable[..., None]
) -> None:
    write_json(cell.path / "identity.json", cell.identity() | {"seed": 7})
    train()
    again = rerun(cell.path)
    told = "\n".join(again.before)
    assert "identity.json has changed" in told
    assert f"not of {cell.id}" in told
    assert "identity.json against config.json: seed: 7 -> 0" in told
    assert not again.differences


def test_other_code_libraries_and_machines_are_told_before_it_trains(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    identity, made_with = cell.identity(), cell.provenance()
    identity["code"] |= {"train.py": "0", "old.py": "1"}
    del identity["code"]["evaluate.py"]
    write_json(cell.path / "identity.json", identity | {"protocol": 0})
    made_with["packages"]["torch"] = "1.0"
    made_with |= {"cpu": "abacus", "git": "f" * 40}
    write_json(cell.path / "provenance.json", made_with)

    def run(*_: object) -> None:
        raise XrgsError("not now")

    monkeypatch.setattr(worker, "run_in_child", run)
    with pytest.raises(XrgsError, match=r"not now \(.*log\.txt"):
        rerun(cell.path)
    told = capsys.readouterr().err
    for text in (
        "code: train.py (changed)",
        "code: old.py (gone)",
        "code: evaluate.py (new)",
        "protocol of evaluation: 0 -> 1",
        "packages.torch: 1.0 -> ",
        "cpu: abacus -> ",
        "git: ffff",
    ):
        assert text in told
    assert CellFolder(cell.path.with_name(f"{cell.id}.rerun-1")).state().name == "failed"


def test_each_rerun_has_a_folder_of_its_own(
    cell: CellFolder, train: Callable[..., None], tmp_path: Path
) -> None:
    train()
    names = [rerun(cell.path).folder.id for _ in range(2)]
    assert names == [f"{cell.id}.rerun-1", f"{cell.id}.rerun-2"]
    assert rerun(cell.path, out=tmp_path / "x" / "y").folder.path == tmp_path / "x" / "y"
    with pytest.raises(XrgsError, match="out="):
        rerun(cell.path, out=tmp_path / "x" / "y")


def test_a_cell_out_of_its_store_takes_its_variant_from_the_one_that_is_named(
    cell: CellFolder, train: Callable[..., None], tmp_path: Path
) -> None:
    (tmp_path / "home").mkdir()
    copied = tmp_path / "home" / "mine"
    shutil.copytree(cell.path, copied)
    train()
    with pytest.raises(XrgsError, match="store="):
        rerun(copied)
    assert not rerun(copied, store=tmp_path / "s").differences


@pytest.mark.parametrize("alike", [True, False])
def test_a_variant_that_is_gone_is_built_and_has_to_be_the_same(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, alike: bool
) -> None:
    wanted = cell.identity()["variant"]
    (tmp_path / "s" / "variants" / wanted).rmdir()
    other = f"{wanted[:16] if alike else '0' * 16}-{'1' * 16}"
    asked: list[Any] = []

    def run(job: str, request: dict[str, Any]) -> dict[str, Any]:
        asked.append((job, request["conf"]["scene"]["path"], request["store"]))
        return {"variant": other}

    monkeypatch.setattr(worker, "run_in_child", run)
    with pytest.raises(XrgsError, match="COLMAP" if alike else "its photographs, or the code"):
        rerun(cell.path, photographs="there")
    assert asked == [("variant", "there", str(tmp_path / "s"))]
    assert not cell.path.with_name(f"{cell.id}.rerun-1").exists()


def spoil_config(cell: CellFolder, change: Callable[[dict[str, Any]], object]) -> None:
    config = json.loads((cell.path / "config.json").read_text())
    change(config)
    write_json(cell.path / "config.json", config)


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda cell: shutil.rmtree(cell.path), "no such folder"),
        (lambda cell: (cell.path / "identity.json").unlink(), r"identity\.json"),
        (lambda cell: (cell.path / "status.json").unlink(), r"no status\.json"),
        (lambda cell: cell.fail("out of memory"), "out of memory"),
        (lambda cell: (cell.path / "config.json").write_text("{"), r"config\.json"),
        (lambda cell: (cell.path / "config.json").write_text("[]"), r"config\.json"),
        (lambda cell: spoil_config(cell, lambda c: c["train"].update(fast=1)), r"train\.fast"),
        (lambda cell: spoil_config(cell, lambda c: c["splat"].pop("sh_every")), r"splat\.sh_every"),
        (lambda cell: spoil_config(cell, lambda c: c["train"].update(steps="x")), r"train\.steps"),
        (
            lambda cell: write_json(cell.path / "identity.json", {"variant": "../../elsewhere"}),
            "variant=",
        ),
        (lambda cell: write_json(cell.path / "identity.json", [1]), r"identity\.json"),
        (lambda cell: write_json(cell.path / "provenance.json", {}), "threads"),
    ],
)
def test_a_folder_that_cannot_be_rerun_is_told_why(
    cell: CellFolder, spoil: Callable[[CellFolder], object], named: str
) -> None:
    spoil(cell)
    with pytest.raises(XrgsError, match=named):
        rerun(cell.path)


@pytest.mark.parametrize(
    ("argument", "named"),
    [
        ("seed=1", "seed"),
        ("threads=-1", "threads=-1"),
        ("threads=x", "threads"),
        ("out=s", "out=s"),
    ],
)
def test_an_argument_that_would_make_another_cell_is_refused(
    run_command: RunCommand, cell: CellFolder, argument: str, named: str
) -> None:
    code, _, err = run_command(
        "sweep", cell.path.parent.parent.parent, f"rerun={cell.path}", argument
    )
    assert code == 1
    assert named in err
    assert "Traceback" not in err


def test_what_is_the_same_says_what_differed_all_the_same(tmp_path: Path) -> None:
    text = str(RerunResult(CellFolder(tmp_path), ["cpu: a -> b"], []))
    assert text.splitlines()[1:3] == ["although these differ:", "  cpu: a -> b"]
    assert os.fspath(tmp_path) in text
