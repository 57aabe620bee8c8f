"""Tests of `xrgs-sweep` as a user runs it: a process of its own, which trains in others.

Both are forks of a process that has imported torch (`tests.forks`).
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

RunCommand = Callable[..., tuple[int, str, str]]
SweepHere = RunCommand
Contents = Callable[[Path], dict[str, str]]
SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=8")


def test_a_sweep_ends_with_the_table_and_keeps_all_that_a_reader_may_need(
    swept: tuple[Path, str], contents: Contents
) -> None:
    folder, out = swept
    for label in ("Training time", "Gaussians", "Memory", "LPIPS", "SSIM", "PSNR", "n/a"):
        assert label in out
    assert "one replicate: no interval" in out
    assert "↑" in out or "↓" in out
    (written,) = map(folder.joinpath, re.findall(r"^Page: (.*)/report\.html$", out, re.MULTILINE))
    assert {"table.md", "table.tex", "table.csv"} <= {file.name for file in written.iterdir()}
    cells = sorted((folder / "s" / "cells").iterdir())
    assert len(cells) == 2
    for cell in cells:
        assert set(contents(cell)) == {
            *("config.json", "history.csv", "identity.json", "log.txt", "provenance.json"),
            *("renders/motorcycle_left.png", "renders/motorcycle_right.png", "scores.csv"),
            *("splats.ply", "status.json", "summary.json"),
        }
        assert json.loads((cell / "provenance.json").read_text())["packages"]["torch"]


def test_a_moved_store_and_naming_the_backend_that_auto_chooses_are_no_change(
    sweep_here: SweepHere, store: Path
) -> None:
    used = json.loads(next((store / "cells").rglob("provenance.json")).read_text())["backend"]
    store.rename(store.with_name("moved"))
    arguments = ("+ablation=consistency", *SMOKE, "store=moved", "dry_run=true")
    _, _, err = sweep_here(*arguments, f"splat.backend={used}", "threads=1", "data_root=x")
    assert "plan: 2 cells, 2 done" in err
    if used == "native":
        assert "plan: 2 cells, 0 done" in sweep_here(*arguments, "splat.backend=torch")[2]


def test_a_count_matched_cell_has_the_gaussians_of_its_reference(
    forked_command: RunCommand, store: Path
) -> None:
    control = ("+ablation=count_matched", "matched_to=gradient_scaling", *SMOKE, f"store={store}")
    code, out, err = forked_command("sweep", store.parent, *control)
    assert code == 0, err
    assert err.count("training cell") == 2
    assert "3 of 3 cells done" in err
    assert "\r" not in err
    assert "count_matched" in out
    configs = [json.loads(f.read_text()) for f in store.glob("cells/*/config.json")]
    matched = [conf["components"]["count_matched"]["gaussians"] for conf in configs]
    counts = [json.loads(f.read_text())["gaussians"] for f in store.glob("cells/*/summary.json")]
    assert max(matched) in counts


def test_a_corrupt_cell_is_trained_again(
    forked_command: RunCommand, store: Path, contents: Contents
) -> None:
    cell = sorted((store / "cells").iterdir())[0]
    before = contents(cell)
    scores = cell / "scores.csv"
    scores.write_text(scores.read_text().replace("0.", "0.9", 1))
    code, _, err = forked_command("sweep", store.parent, "+ablation=consistency", *SMOKE, "store=s")
    assert code == 0
    assert "corrupt" in err
    assert "1 done" in err
    # It is trained again to the same bits; the corrupt folder is kept beside it.
    assert contents(cell)["splats.ply"] == before["splats.ply"]
    assert contents(cell)["scores.csv"] == before["scores.csv"]
    assert cell.with_name(f"{cell.name}.aside-1").is_dir()


def test_a_scene_that_fails_leaves_the_other_scenes(
    forked_command: RunCommand, store: Path, photographs: Callable[..., Path]
) -> None:
    flat = photographs(store.parent / "flat", 6)
    (store.parent / "mine/scene").mkdir(parents=True)
    text = f"name: flat\nkind: folder\npath: {flat}\n"  # the embedded scene has no path
    (store.parent / "mine/scene/flat.yaml").write_text(text)
    scenes = ("scene=motorcycle,flat", "--config-dir", "mine")
    arguments = ("+ablation=consistency", *SMOKE[1:], *scenes, "store=s")
    code, out, err = forked_command("sweep", store.parent, *arguments)
    assert code == 1
    assert "flat" in err
    assert "registered" in err
    assert "failed" in out
    assert "Training time" in out  # the table of the other scene


def test_the_child_imports_the_package_of_its_parent_and_not_that_of_its_folder(
    tmp_path: Path,
) -> None:
    (tmp_path / "xrgs").mkdir()
    (tmp_path / "xrgs" / "__init__.py").write_text("raise ImportError('the wrong package')")
    script = "import sys; sys.path.remove(''); from xrgs.sweep.job import run_in_child; "
    script += "run_in_child('cell', {'cell': 'gone', 'inode': 0})"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "WorkError: gone: another attempt at the cell has begun" in done.stderr
    assert "the wrong package" not in done.stderr
