"""Tests that a cell is trained again from its folder and compared with it."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from PIL import Image

from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.safeio.atomic import write_json
from xrgs.store import provenance
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_id, cell_identity
from xrgs.store.store import Store
from xrgs.sweep import job
from xrgs.sweep.rerun import rerun


@pytest.fixture(scope="module")
def trained(compose: Callable[..., Conf], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished cell in a store `s`, which was not really trained."""
    store = Store(tmp_path_factory.mktemp("trained") / "s")
    store.prepare()
    conf = compose("scene=motorcycle", "train.steps=2", "threads=1", "splat.backend=torch")
    variant_id = "0123456789abcdef-0123456789abcdef"
    identity = cell_identity(conf, variant_id)
    folder = store.cell(cell_id(identity))
    plan_cell(folder, conf, identity)
    begin_attempt(folder)
    made = msgspec.to_builtins(provenance.collect(1, "torch"))
    write_json(folder.path / "provenance.json", made)
    scores = "view,lpips,ssim,psnr\nmotorcycle_left,,0.02,6.50\nmotorcycle_right,,0.03,7.50\n"
    (folder.path / "scores.csv").write_text(scores)
    (folder.path / "history.csv").write_text("step,loss\n0,0.5\n")
    (folder.path / "splats.ply").write_bytes(b"ply")
    summary = {"steps": 2, "gaussians": 105, "evaluations": 916072, "grow_grad2d": 2e-4}
    summary |= {"training_time_s": 1.0, "render_time_ms": 1.0, "memory_bytes": 1}
    write_json(folder.path / "summary.json", summary)
    folder.finish(["motorcycle_left", "motorcycle_right"], {})
    return folder.path


@pytest.fixture
def cell(trained: Path, tmp_path: Path) -> CellFolder:
    """A copy of it in a store of its own, without its variant's images."""
    copied = tmp_path / "s" / "cells" / trained.name
    shutil.copytree(trained, copied)
    variant = CellFolder(trained).identity().variant
    (tmp_path / "s" / "variants" / variant).mkdir(parents=True)
    return CellFolder(copied)


@pytest.fixture
def train(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """(file, old, new, ...) -> stand in for the training: what it gives has these changes."""

    def fake(*changes: tuple[str, str, str]) -> None:
        def run(work: str, request: Mapping[str, Any]) -> dict[str, Any]:
            assert work == "cell"
            folder = CellFolder(Path(request["cell"]))
            for name in ("scores.csv", "history.csv", "splats.ply", "summary.json"):
                shutil.copy(trained / name, folder.path)
            for name, old, new in changes:
                file = folder.path / name
                file.write_text(file.read_text().replace(old, new, 1))
            folder.finish([], {})
            return {}

        monkeypatch.setattr(job, "run_in_child", run)

    return fake


def test_a_cell_that_is_older_than_a_key_is_trained_with_the_baselines_value(
    cell: CellFolder, train: Callable[..., None]
) -> None:
    file = cell.path / "config.json"
    older = json.loads(file.read_text())
    del older["track"], older["train"]["validation"], older["components"]["mip"]
    file.write_text(json.dumps(older))
    train()
    result = rerun(cell.path)
    (line,) = [line for line in result.before if line.startswith("config.json")]
    assert line == (
        "config.json lacks newer keys; their values in the baseline are taken:"
        " train.validation=0.0, components.mip.variance=0.0, components.mip.every=100,"
        " track=none"
    )
    assert CellFolder(result.folder.path).config().train.validation == 0


def test_scores_that_were_changed_are_reported(
    cell: CellFolder, train: Callable[..., None]
) -> None:
    scores = cell.path / "scores.csv"
    header, first, *others = scores.read_text().splitlines()
    left, _, psnr = first.rpartition(",")
    changed = f"{left},{float(psnr) + 0.25}"
    scores.write_text("\n".join([header, changed, *others]) + "\n")
    gaussians = cell.summary().gaussians
    train(("summary.json", f'"gaussians": {gaussians}', '"gaussians": 12345'))
    result = rerun(cell.path)
    assert result.before == ["the folder: corrupt: scores.csv has changed since the cell finished"]
    assert result.differences == [
        "psnr: differs in 1 views, by at most 0.25",
        f"gaussians: {gaussians:,} -> 12,345",
        "scores.csv: the bytes differ",
    ]
    assert str(result).startswith("The numbers are not the same.\ndifferences in code")


def test_scores_of_other_views_and_metrics_are_reported(
    cell: CellFolder, train: Callable[..., None]
) -> None:
    train(("scores.csv", "motorcycle_left", "another"), ("scores.csv", "lpips", "dists"))
    text = "\n".join(rerun(cell.path).differences)
    assert "scores.csv: only one of the two has another, motorcycle_left" in text
    train(("scores.csv", ",,", ",0.5,"))  # LPIPS has no weights in tests
    (cell.path / "splats.ply").unlink()
    result = rerun(cell.path)
    assert result.before == ["the folder: corrupt: splats.ply is missing or has another size"]
    assert "lpips: differs in 1 views, and one of the two has no score" in result.differences


def test_other_code_libraries_and_machines_are_reported_before_the_training(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    change(cell, "identity.json", code={"core": "0", "old": "1"}, arithmetic="no-fma")
    packages = cell.provenance().packages | {"torch": "1.0"}
    change(cell, "provenance.json", packages=packages, cpu="abacus", git="f" * 40)

    def run(*_: object) -> None:
        raise XrgsError("not now")

    monkeypatch.setattr(job, "run_in_child", run)
    with pytest.raises(XrgsError, match=r"not now \(.*log\.txt"):
        rerun(cell.path)
    err = capsys.readouterr().err
    for text in (
        "code: core: 0 -> ",
        "code: old: 1 -> None",
        "arithmetic, which decides the last digits: no-fma -> ",
        "packages.torch: 1.0 -> ",
        "cpu: abacus -> ",
        "git: ffff",
    ):
        assert text in err
    assert CellFolder(cell.path.with_name(f"{cell.id}.rerun-1")).state().name == "failed"


def test_each_rerun_has_a_folder_of_its_own(
    cell: CellFolder, train: Callable[..., None], tmp_path: Path
) -> None:
    train()
    results = [rerun(cell.path) for _ in range(2)]
    assert [result.folder.id for result in results] == [f"{cell.id}.rerun-{n}" for n in (1, 2)]
    assert str(results[0]).startswith("the same, bit for bit: ")
    assert rerun(cell.path, out=tmp_path / "x" / "y").folder.path == tmp_path / "x" / "y"
    with pytest.raises(XrgsError, match="out="):
        rerun(cell.path, out=tmp_path / "x" / "y")
    with pytest.raises(XrgsError, match="threads=-1"):
        rerun(cell.path, threads=-1)


def test_a_cell_outside_of_a_store_takes_its_variant_from_the_one_that_is_named(
    cell: CellFolder, train: Callable[..., None], tmp_path: Path
) -> None:
    (tmp_path / "home").mkdir()
    copied = tmp_path / "home" / "mine"
    shutil.copytree(cell.path, copied)
    train()
    with pytest.raises(XrgsError, match="store="):
        rerun(copied)
    assert not rerun(copied, store=tmp_path / "s").differences


@pytest.mark.parametrize("same_key", [True, False])
def test_a_missing_variant_is_built_and_has_to_be_the_same(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, same_key: bool
) -> None:
    variant_id = cell.identity().variant
    (tmp_path / "s" / "variants" / variant_id).rmdir()
    spoil_config(cell, lambda c: c["scene"].update(kind="folder"))  # an embedded one has no path
    there = tmp_path / "there"
    there.mkdir()
    for grey in range(3):
        Image.new("RGB", (64, 48), (grey,) * 3).save(there / f"{grey}.png")
    other = f"{variant_id[:16] if same_key else '0' * 16}-{'1' * 16}"
    requests: list[Any] = []

    def run(work: str, request: dict[str, Any], *_: object) -> dict[str, Any]:
        requests.append((work, request["conf"]["scene"]["path"], request["store"]))
        return {"variant": other}

    monkeypatch.setattr(job, "run_in_child", run)
    with pytest.raises(XrgsError, match="COLMAP" if same_key else "its photographs, or the code"):
        rerun(cell.path, photographs=str(there))
    assert requests == [("variant", str(there), str(tmp_path / "s"))]
    assert not cell.path.with_name(f"{cell.id}.rerun-1").exists()


def change(cell: CellFolder, name: str, **values: Any) -> None:
    """Change values of one of the cell's JSON files."""
    content = json.loads((cell.path / name).read_text())
    write_json(cell.path / name, content | values)


def spoil_config(cell: CellFolder, change: Callable[[dict[str, Any]], object]) -> None:
    config = json.loads((cell.path / "config.json").read_text())
    change(config)
    write_json(cell.path / "config.json", config)


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda cell: shutil.rmtree(cell.path), "no such folder"),
        (lambda cell: (cell.path / "status.json").unlink(), r"no status\.json"),
        (lambda cell: cell.fail("out of memory"), "out of memory"),
        (lambda cell: (cell.path / "config.json").write_text("{"), r"config\.json"),
        (lambda cell: spoil_config(cell, lambda c: c["train"].update(fast=1)), r"train\.fast"),
        (lambda cell: change(cell, "identity.json", variant="../../elsewhere"), "variant"),
        (lambda cell: write_json(cell.path / "provenance.json", {}), "provenance"),
    ],
)
def test_a_folder_that_can_not_be_rerun_is_refused_with_a_reason(
    cell: CellFolder, spoil: Callable[[CellFolder], object], named: str
) -> None:
    spoil(cell)
    with pytest.raises(XrgsError, match=named):
        rerun(cell.path)


@pytest.mark.parametrize("name", ["status.json", "splats.ply"])
def test_a_file_that_can_not_be_read_now_is_named(
    cell: CellFolder, train: Callable[..., None], unreadable: Callable[..., None], name: str
) -> None:
    train()
    unreadable(f"{cell.id}/{name}", errno.EIO)
    with pytest.raises(XrgsError, match=os.strerror(errno.EIO)) as caught:
        rerun(cell.path)
    assert f"{cell.id}/{name}" in str(caught.value)


def test_names_of_a_foreign_cell_are_not_obeyed(
    cell: CellFolder, train: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    code = cell.identity().code | {"x\x1b]0;t\x07\nthe same.py": "0"}
    change(cell, "identity.json", code=code)
    change(cell, "provenance.json", cpu="\x1b[2J" + "x" * 1000)
    train(("summary.json", '"steps": ', '"steps": 1'))
    text = str(rerun(cell.path))
    for shown in (text, capsys.readouterr().err):
        assert shown.replace("\n", "").isprintable()
        assert "  code: x ]0;t  the same.py: 0 -> None\n" in shown
        assert max(map(len, shown.split("\n"))) < 300
