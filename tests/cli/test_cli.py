"""The commands as a user runs them: processes of their own, from another folder."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("kornia", "matplotlib", "pandas", "pycolmap", "scipy", "skimage", "torch")
SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=8")
#: As `tests.conftest.run_command` gives it.
RunCommand = Callable[..., tuple[int, str, str]]


def without_heavy(folder: Path) -> str:
    """A PYTHONPATH where what takes long to import can't be: who waits for training only waits."""
    for name in HEAVY:
        (folder / f"{name}.py").write_text(f"raise ImportError('{name} was imported')")
    return os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])


def contents(folder: Path) -> dict[str, str]:
    return {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def photographs(folder: Path, count: int, size: tuple[int, int] = (120, 90)) -> Path:
    """Flat pictures in which SIFT finds nothing."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        pixels = np.full((size[1], size[0], 3), 40 + number, np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def swept(run_command: RunCommand, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with a finished smoke sweep in its store `s`, and what was printed."""
    folder = tmp_path_factory.mktemp("swept")
    code, out, err = run_command("sweep", folder, "+ablation=consistency", *SMOKE, "store=s")
    assert code == 0, err
    return folder, out


@pytest.fixture
def store(swept: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of the finished store that a test may spoil."""
    shutil.copytree(swept[0] / "s", tmp_path / "s")
    return tmp_path / "s"


def test_a_sweep_ends_with_the_table_and_where_it_is(swept: tuple[Path, str]) -> None:
    folder, out = swept
    for label in ("Training time", "Gaussians", "Memory", "LPIPS", "SSIM", "PSNR"):
        assert label in out
    assert "n/a" in out
    assert "one seed: no interval" in out
    assert "↑" in out or "↓" in out
    written = folder / out.strip().rpartition("Written to ")[2]
    assert {"table.md", "table.tex", "table.csv"} <= {file.name for file in written.iterdir()}


def test_a_cell_keeps_all_that_a_reader_may_ask_for(swept: tuple[Path, str]) -> None:
    cells = sorted((swept[0] / "s" / "cells").iterdir())
    assert len(cells) == 2
    for cell in cells:
        assert set(contents(cell)) == {
            "config.json",
            "history.csv",
            "identity.json",
            "log.txt",
            "provenance.json",
            "renders/motorcycle_left.png",
            "renders/motorcycle_right.png",
            "scores.csv",
            "splats.ply",
            "status.json",
            "summary.json",
        }
        assert json.loads((cell / "provenance.json").read_text())["packages"]["torch"]


def test_the_report_is_rebuilt_byte_for_byte(run_command: RunCommand, store: Path) -> None:
    before = contents(store / "reports")
    shutil.rmtree(store / "reports")
    code, out, err = run_command("report", store.parent, "store=s")
    assert code == 0, err
    assert "consistency against baseline" in out
    assert contents(store / "reports") == before


def test_a_report_has_the_pictures_that_are_asked_for(
    run_command: RunCommand, store: Path, tmp_path: Path
) -> None:
    for asked, drawn in (("none", []), ("motorcycle--consistency", ["motorcycle--consistency"])):
        out = tmp_path / asked
        code, _, err = run_command(
            "report", store.parent, "store=s", f"out={out}", f"pictures={asked}"
        )
        assert code == 0, err
        assert [file.stem for file in (out / "figures").iterdir()] == drawn
    code, _, err = run_command("report", store.parent, "store=s", f"out={out}", "pictures=gone")
    assert code == 1
    assert "pictures=gone" in err
    assert "motorcycle--consistency--training" in err


def test_a_second_run_trains_nothing(run_command: RunCommand, store: Path) -> None:
    before = contents(store / "cells")
    code, out, err = run_command("sweep", store.parent, "+ablation=consistency", *SMOKE, "store=s")
    assert code == 0, err
    assert "plan: 2 cells, 2 done" in err
    assert "training" not in err
    assert "consistency against baseline" in out
    assert contents(store / "cells") == before


@pytest.mark.parametrize(
    "change",
    ["seed=1", "train.steps=9", "components.loss_weighting.lr_weight=0.5", "splat.backend=torch"],
)
def test_a_changed_value_is_another_cell(run_command: RunCommand, store: Path, change: str) -> None:
    arguments = ("+ablation=consistency", *(a for a in SMOKE if "steps" not in a), "train.steps=8")
    _, _, err = run_command("sweep", store.parent, *arguments, change, "store=s", "dry_run=true")
    backend = json.loads(next((store / "cells").rglob("provenance.json")).read_text())["backend"]
    if change == f"splat.backend={backend}":
        assert "2 done" in err  # naming what `auto` chose is no change
    elif "components" in change:
        assert "1 done" in err  # the baseline has no component
    else:
        assert "0 done" in err


def test_a_cell_that_takes_its_count_from_another_is_trained_after_it(
    run_command: RunCommand, store: Path
) -> None:
    control = ("+ablation=count_matched", "matched_to=gradient_scaling", *SMOKE, f"store={store}")
    code, _, err = run_command("sweep", store.parent, *control, "dry_run=true")
    assert code == 0, err
    states = [line.split()[0] for line in err.splitlines() if "motorcycle /" in line]
    assert states == ["done", "absent", "waits"], err
    code, out, err = run_command("sweep", store.parent, *control)
    assert code == 0, err
    assert err.count("training cell") == 2
    assert "3 of 3 cells done" in err
    assert "\r" not in err
    assert "count_matched" in out
    configs = [json.loads(f.read_text()) for f in store.glob("cells/*/config.json")]
    wanted = [c["components"]["count_matched"]["gaussians"] for c in configs]
    counts = [json.loads(f.read_text())["gaussians"] for f in store.glob("cells/*/summary.json")]
    assert max(wanted) in counts
    _, _, err = run_command("sweep", store.parent, *control)
    assert "plan: 3 cells, 3 done" in err


def test_paths_threads_and_labels_are_no_change(run_command: RunCommand, store: Path) -> None:
    store.rename(store.with_name("moved"))
    arguments = ("+ablation=consistency", *SMOKE, "threads=1", "data_root=x", "scene.name=y")
    _, _, err = run_command("sweep", store.parent, *arguments, "store=moved", "dry_run=true")
    assert "2 done" in err


def test_a_corrupt_cell_is_run_again_and_not_trusted(run_command: RunCommand, store: Path) -> None:
    cell = sorted((store / "cells").iterdir())[0]
    before = contents(cell)
    scores = cell / "scores.csv"
    scores.write_text(scores.read_text().replace("0.", "0.9", 1))
    code, _, err = run_command("sweep", store.parent, "+ablation=consistency", *SMOKE, "store=s")
    assert code == 0
    assert "corrupt" in err
    assert "1 done" in err
    # Trained anew to the same bits; the spoilt folder is kept beside it.
    assert contents(cell)["splats.ply"] == before["splats.ply"]
    assert contents(cell)["scores.csv"] == before["scores.csv"]
    assert cell.with_name(f"{cell.name}.aside-1").is_dir()


def test_a_scene_that_fails_does_not_take_the_sweep_with_it(
    run_command: RunCommand, store: Path
) -> None:
    flat = photographs(store.parent / "flat", 6)
    scenes = ("scene=motorcycle,folder", f"scene.path={flat}")
    arguments = ("+ablation=consistency", *SMOKE[1:], *scenes, "store=s")
    code, out, err = run_command("sweep", store.parent, *arguments)
    assert code == 1
    assert "flat" in err
    assert "registered" in err
    assert "failed" in out
    assert "Training time" in out  # the other scene's table


def test_the_child_imports_what_its_parent_did_and_not_the_folder_it_stands_in(
    tmp_path: Path,
) -> None:
    (tmp_path / "xrgs").mkdir()
    (tmp_path / "xrgs" / "__init__.py").write_text("raise ImportError('the wrong package')")
    script = "import sys; sys.path.remove(''); from xrgs.cli.sweep import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", script, *SMOKE, "train.steps=2", "store=s"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_dry_run_plans_without_torch_and_writes_nothing(
    run_command: RunCommand, tmp_path: Path
) -> None:
    arguments = ("+ablation=consistency,loss_weighting", "seed=0,1", "dry_run=true", "store=s")
    code, _, err = run_command("sweep", tmp_path, *arguments, PYTHONPATH=without_heavy(tmp_path))
    assert code == 0, err
    assert "plan: 6 cells" in err
    assert err.count("variant not built") == 6
    assert {file.stem for file in tmp_path.iterdir()} == set(HEAVY)


@pytest.mark.parametrize("sweep", sorted(file.stem for file in (ROOT / "sweeps").glob("*.yaml")))
def test_every_sweep_file_plans(run_command: RunCommand, tmp_path: Path, sweep: str) -> None:
    code, _, err = run_command("sweep", tmp_path, f"+sweeps={sweep}", "dry_run=true")
    assert code == 0, err
    assert labels(err) > {"baseline"}


def labels(plan: str) -> set[str]:
    """What is compared in a printed plan: its cells' second names."""
    return {line.split(" / ")[1] for line in plan.splitlines() if " / seed " in line}


def test_every_ablation_is_in_a_sweep(run_command: RunCommand, tmp_path: Path) -> None:
    planned: set[str] = set()
    for sweep in ("ablations", "controls"):
        planned |= labels(run_command("sweep", tmp_path, f"+sweeps={sweep}", "dry_run=true")[2])
    assert planned == {file.stem for file in (ROOT / "conf" / "ablation").glob("*.yaml")}


def test_stacked_ablations_and_the_forgotten_plus(run_command: RunCommand, tmp_path: Path) -> None:
    _, _, err = run_command(
        "sweep", tmp_path, "ablation=[loss_weighting,consistency]", "dry_run=true"
    )
    assert "loss_weighting+consistency" in err
    assert "plan: 2 cells" in err


@pytest.mark.parametrize("command", ["sweep", "report", "status", "bench", "data"])
def test_help_answers_at_once(run_command: RunCommand, tmp_path: Path, command: str) -> None:
    code, out, err = run_command(command, tmp_path, "--help", PYTHONPATH=without_heavy(tmp_path))
    assert code == 0, err
    assert f"xrgs-{command}" in out
    assert "=" in out


def test_help_names_every_choice(run_command: RunCommand, tmp_path: Path) -> None:
    code, out, _ = run_command("sweep", tmp_path, "--help")
    assert code == 0
    for name in ("consistency", "llff/fern", "motorcycle", "laptop", "smoke"):
        assert name in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["+ablation=nope"], ["ablation/nope", "consistency"]),
        (["scene=nope"], ["scene/nope", "procedural"]),
        (["train.stpes=3"], ["train.stpes"]),
        (["train.steps=many"], ["train.steps", "many"]),
        (["seed=interval(0,1)"], ["interval"]),
        (["scene=folder"], ["scene.path"]),
        (["scene=folder", "scene.path=gone"], ["gone"]),
        (["scene=folder", "scene.path=empty"], ["empty"]),
        (["scene=folder", "scene.path=one"], ["one"]),
        (["scene=folder", "scene.path=sizes", "variant.sfm.camera=single"], ["sizes", "90"]),
        (["scene=folder", "scene.path=broken"], ["broken"]),
        (["scene=folder", "scene.path=small"], ["variant.factor"]),
        (["store=in-the-way"], ["in-the-way", "store="]),
        (["components.loss_weighting.lr_weight=-1"], ["components.loss_weighting.lr_weight"]),
        (["train.steps=0"], ["train.steps"]),
        (["checkpoint_s=nan"], ["checkpoint_s"]),
        (["splat.backend=cuda"], ["splat.backend=cuda", "native"]),
    ],
    ids=" ".join,
)
def test_bad_input_is_named_and_loses_nothing(
    run_command: RunCommand, tmp_path: Path, arguments: list[str], named: list[str]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "in-the-way").write_text("a file")
    photographs(tmp_path / "one", 1)
    photographs(tmp_path / "sizes", 5)
    Image.new("RGB", (90, 120)).save(tmp_path / "sizes" / "2.png")
    for file in photographs(tmp_path / "broken", 5).iterdir():
        file.write_bytes(file.read_bytes()[:60])
    photographs(tmp_path / "small", 5, (40, 30))
    code, out, err = run_command("sweep", tmp_path, "preset=smoke", *arguments)
    assert code != 0
    for text in named:
        assert text in out + err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [(["store=gone"], "gone"), (["stroe=x"], "stroe"), (["sweep=nope", "store=s"], "nope")],
)
def test_a_report_that_cannot_be_made_says_why(
    run_command: RunCommand, tmp_path: Path, arguments: list[str], named: str
) -> None:
    (tmp_path / "s" / "sweeps").mkdir(parents=True)
    code, _, err = run_command("report", tmp_path, *arguments)
    assert code == 1
    assert named in err
    assert "Traceback" not in err


def test_a_trained_cell_becomes_a_load_of_the_benchmark(
    run_command: RunCommand, swept: tuple[Path, str]
) -> None:
    folder, _ = swept
    cell = sorted((folder / "s" / "cells").iterdir())[0]
    view = json.loads((cell / "status.json").read_text())["views"][0]
    code, out, err = run_command("bench", folder, "save=a.npz", f"cell={cell}", f"view={view}")
    assert code == 0, err
    with np.load(folder / "a.npz") as stored:
        count = json.loads((cell / "summary.json").read_text())["gaussians"]
        assert stored["means"].shape == (count, 3)
        assert stored["sh"].shape == (count, 16, 3)
        assert ((stored["opacities"] > 0) & (stored["opacities"] < 1)).all()
        with Image.open(cell / "renders" / f"{view}.png") as picture:
            assert picture.size == (stored["width"], stored["height"])
    assert f"{count} Gaussians" in out
    code, _, err = run_command("bench", folder, "save=a.npz", f"cell={cell}", "view=none")
    assert code != 0
    assert "view=none" in err
    assert view in err
