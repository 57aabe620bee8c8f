"""Tests of `xrgs-sweep`: plans, and whole sweeps whose child processes are stood in for."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from xrgs.cli.sweep import explain
from xrgs.config import CONF_DIR, Conf, known_keys
from xrgs.errors import XrgsError
from xrgs.mixture import variant
from xrgs.store.store import Store

SweepHere = Callable[..., tuple[int, str, str]]
RunCommand = Callable[..., tuple[int, str, str]]
SCENE = ("scene=motorcycle", "preset=smoke", "store=s")
SWEEPS = CONF_DIR / "sweeps" if (CONF_DIR / "sweeps").is_dir() else CONF_DIR.parent / "sweeps"
#: The sweeps that have every ablation between them.
WHOLE = ("ablations", "readings", "recipes", "arms", "paper_size")


def arms(sweep: str) -> set[str]:
    """Return the labels of the arms that a sweep's file names, and the baseline, which all have."""
    axes = OmegaConf.load(SWEEPS / f"{sweep}.yaml").hydra.sweeper.params
    names = re.findall(r"\[[^]]*\]|\w+", axes["+ablation"])
    return {name.strip("[]").replace(",", "+") for name in names} | {"baseline"}


def labels(plan: str) -> set[str]:
    """Return what is compared in a printed plan: the second names of its cells."""
    return {line.split(" / ")[1] for line in plan.splitlines() if " / seed " in line}


def test_a_sweep_trains_each_cell_once_and_ends_with_the_table(
    sweep_here: SweepHere, children: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed = []

    def key(*_: object) -> str:
        hashed.append("photographs")
        return "0123456789abcdef"

    monkeypatch.setattr(variant, "key", key)
    arguments = ("+ablation=consistency", "seed=0,1", "threads=3", *SCENE)
    code, out, err = sweep_here(*arguments)
    assert code == 0, err
    assert len(hashed) == 1, "once for all cells of a scene"
    assert "motorcycle: building the mixed-resolution variant\n" in err
    assert "plan: 4 cells, 0 done" in err
    assert "LPIPS will be n/a" in err  # lpips.fetch is off in tests
    assert out.startswith("the table\n\n4 done cells\n")
    assert len(children.trained) == len(set(children.trained)) == 4
    assert all(cell_id in out for cell_id in children.trained)
    store = Store(tmp_path / "s")
    first, last = (str(row.cell_id)[:8] for row in store.sweep_record().cells[2:])
    assert f"\n  xrgs-view {first} {last} --store s\n" in out  # a cell and its baseline
    assert f"xrgs-data export {last} --out consistency.ply --store s" in out
    assert out.count("xrgs-view") == 1
    folder = store.cell(children.trained[0])
    conf = folder.config()
    assert (conf.store, conf.threads) == (str(tmp_path / "s"), 3)
    assert folder.identity().train["steps"] == conf.train.steps
    code, out, err = sweep_here(*arguments)
    assert code == 0, err
    assert "plan: 4 cells, 4 done" in err
    assert len(children.trained) == 4
    record = store.sweep_record()
    assert [row.label for row in record.cells] == ["baseline", "consistency"] * 2
    assert record.cells[1].baseline_id == record.cells[0].cell_id


@pytest.mark.slow
def test_without_the_baseline_the_ablations_are_trained_alone(
    sweep_here: SweepHere, children: Any, tmp_path: Path
) -> None:
    code, _, err = sweep_here("+ablation=densify", "baseline=false", *SCENE)
    assert code == 0, err
    assert len(children.trained) == 1
    rows = Store(tmp_path / "s").sweep_record().cells
    assert [(row.label, row.baseline_id) for row in rows] == [("densify", None)]
    control = ("+ablation=count_matched", "matched_to=baseline", *SCENE)
    _, _, err = sweep_here(*control, "baseline=false", "dry_run=true")
    assert labels(err) == {"baseline", "count_matched to baseline"}, "the count is taken from it"
    code, _, err = sweep_here(*SCENE, "baseline=false", "dry_run=true")
    assert code == 1
    assert "baseline=false: no cell is left" in err


@pytest.mark.slow
def test_a_cell_that_fails_leaves_the_others_and_is_not_tried_again(
    sweep_here: SweepHere, children: Any
) -> None:
    children.failures = {1: "it raised"}
    code, out, err = sweep_here("seed=0,1,2", *SCENE)
    assert code == 1
    assert out.startswith("the table\n\n2 done cells\n")
    assert "failed: it raised" in err
    assert len(children.trained) == 3
    children.failures = {5: "it raised", 6: "it raised"}
    code, _, err = sweep_here("seed=1,5,6", *SCENE, "fail_fast=true")
    assert code == 1
    assert "retry=failed trains them again" in err
    assert "no further cell is started: fail_fast, and a cell failed" in err
    assert len(children.trained) == 4
    children.failures = {}
    code, _, err = sweep_here("seed=1", *SCENE, "retry=failed")
    assert code == 0, err
    assert len(children.trained) == 5


@pytest.mark.slow
def test_each_arm_has_a_control_and_a_count_out_of_reach_fails_one(
    sweep_here: SweepHere, children: Any, tmp_path: Path
) -> None:
    arms = "consistency,gradient_scaling"
    arguments = (f"+ablation={arms},count_matched", f"matched_to={arms}", *SCENE)
    # The baseline and the arms come first; the last one trained is gradient_scaling.
    children.unreachable = children.gaussians + 3
    code, _, err = sweep_here(*arguments)
    assert code == 1
    states = [line.split()[0] for line in err.splitlines() if "motorcycle /" in line]
    assert states[:5].count("waits") == 2, "for the counts of their arms"
    store = Store(tmp_path / "s")
    rows = {row.label: str(row.cell_id) for row in store.sweep_record().cells}
    assert len(rows) == len(children.trained) == 5
    missing = []
    for arm in arms.split(","):
        count = store.cell(rows[arm]).summary().gaussians
        control = store.cell(rows[f"count_matched to {arm}"])
        assert control.identity().components["count_matched"]["gaussians"] == count
        if control.state().name != "done":
            missing.append((count, control.state().reason))
    assert missing == [
        (children.unreachable, f"no threshold gave {children.unreachable} Gaussians")
    ]
    assert "plan: 5 cells, 4 done" in sweep_here(*arguments, "dry_run=true")[2]


@pytest.mark.slow
def test_a_sweep_file_plans(sweep_here: SweepHere) -> None:
    """tests/test_ablations.py composes each value of every file."""
    code, _, err = sweep_here("+sweeps=captures", "scene=motorcycle", "seed=0", "dry_run=true")
    assert code == 0, err
    assert {label.partition(" to ")[0] for label in labels(err)} == arms("captures")


def test_every_ablation_is_in_a_sweep() -> None:
    swept = {name for sweep in WHOLE for arm in arms(sweep) for name in arm.split("+")}
    assert swept == {file.stem for file in (CONF_DIR / "ablation").glob("*.yaml")}


def test_a_single_run_is_refused(sweep_here: SweepHere, children: Any) -> None:
    code, _, err = sweep_here(*SCENE, "hydra.mode=RUN")
    assert code == 1
    assert "hydra.mode must be MULTIRUN" in err
    assert not children.trained


@pytest.mark.slow
def test_a_launcher_named_in_an_ablation_is_refused(sweep_here: SweepHere, tmp_path: Path) -> None:
    (tmp_path / "mine" / "ablation").mkdir(parents=True)
    for name in ("here", "there"):
        file = tmp_path / "mine" / "ablation" / f"{name}.yaml"
        file.write_text("# @package _global_\ndefaults:\n  - override /hydra/launcher: joblib\n")
    code, _, err = sweep_here("+ablation=here,there", "dry_run=true", "--config-dir", "mine")
    assert code == 1
    assert "a launcher is chosen once for a sweep" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["train.steps=many"], ["train.steps", "many"]),
        (["scene=folder"], ["scene.path"]),
        (["scene.path=empty"], ["write scene=folder scene.path=empty"]),
        (["scene=folder", "scene.path=one"], ["one"]),
        (["store=in-the-way"], ["in-the-way", "store="]),
        (["rerun=~/gone"], [f"rerun={Path.home() / 'gone'}: there is no such folder"]),
        (["rerun=gone", "seed=1"], ["seed", "rerun= takes out="]),
        (["rerun=gone", "threads=x"], ["threads"]),
    ],
    ids=" ".join,
)
def test_bad_input_is_named(
    sweep_here: SweepHere,
    tmp_path: Path,
    photographs: Callable[..., Path],
    arguments: list[str],
    named: list[str],
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "in-the-way").write_text("a file")
    photographs(tmp_path / "one", 1)
    dry = [] if arguments[0].startswith("rerun=") else ["preset=smoke", "dry_run=true"]
    code, out, err = sweep_here(*dry, *arguments)
    assert code == 1
    for text in named:
        assert text in out + err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["variant.factor=0", "seed=0,1"], "variant.factor=0: must be 1 or more"),
        (["store=a.txt/s"], "store=a.txt/s can't be written"),
    ],
    ids=" ".join,
)
def test_a_dry_run_says_each_error_once_and_fails(
    sweep_here: SweepHere, tmp_path: Path, arguments: list[str], message: str
) -> None:
    (tmp_path / "a.txt").write_text("not a folder")
    given = [word for word in SCENE if not (word[:5] == arguments[0][:5] == "store")]
    code, out, err = sweep_here(*given, *arguments, "dry_run=true")
    assert (code, out) == (1, "")
    assert err.count(message) == 1
    assert len(err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.slow
def test_a_dry_run_fails_where_photographs_are_missing_and_says_once_how_to_get_them(
    sweep_here: SweepHere, tmp_path: Path
) -> None:
    scene = ("scene=folder", "scene.path=gone", "preset=smoke", "seed=0,1")
    code, _, err = sweep_here(*scene, "dry_run=true")
    assert code == 1
    assert err.count("scene.path=gone: no such folder") == 1
    assert err.count("(the same)") == 1
    study = ("scene=llff/fern,llff/flower", "dry_run=true")
    code, _, err = sweep_here(*study, "data_root=x/my photographs")
    assert code == 1
    assert err.count("xrgs-data download llff fern flower --data-root 'x/my photographs'\n") == 1
    (tmp_path / "data/llff/fern").mkdir(parents=True)
    code, _, err = sweep_here(*study)
    assert err.count("to download what is missing: xrgs-data download llff flower\n") == 1
    for given in ("data", "data/llff/fern"):
        code, _, err = sweep_here("scene=llff/fern", f"data_root={given}", "dry_run=true")
        assert code == 1
        assert "data/llff/fern is there: data_root=data/llff\n" in err
        assert "download" not in err


@pytest.mark.slow
def test_captures_are_looked_for_in_their_own_folder(sweep_here: SweepHere) -> None:
    code, _, err = sweep_here("scene=captures/monstree,captures/ollie", "dry_run=true")
    assert code == 1
    assert "scene.path=data/captures/ollie" in err
    assert err.count("docs/study.md says where their photographs are from") == 1
    assert "they belong into data/captures/monstree, data/captures/ollie\n" in err


@pytest.mark.slow
def test_ablations_stack_and_one_that_changes_nothing_is_named_in_the_plan(
    sweep_here: SweepHere,
) -> None:
    off = ("ablation=[loss_weighting,consistency],consistency", "components.consistency.weight=0")
    code, _, err = sweep_here(*SCENE, *off, "dry_run=true")  # the plus may be forgotten
    assert code == 0, err
    assert "loss_weighting+consistency" in err
    assert "consistency consistency.weight=0 changes nothing here" in err


def test_keys_are_explained_by_the_comments_beside_them() -> None:
    above, behind = explain("train.steps"), explain("variant.hr_fraction")
    assert above.startswith("train.steps=30000\n  Number of steps, one view a step")
    assert behind.startswith("variant.hr_fraction=0.3\n  share of the training views that are HR")
    assert "train.views" not in above
    assert "--cfg job" in above
    group = explain("limits")
    assert group.index("limits.minutes=0.0") < group.index("limits.memory_gb=0.0")
    with pytest.raises(
        XrgsError, match=r"help=stesp: there is no such key; did you mean train\.steps"
    ):
        explain("stesp")


def test_every_key_of_the_schema_is_explained() -> None:
    """By a comment of its own, or as a group by those of its keys."""
    for key in known_keys():
        if key.partition(".")[0] not in Conf.__dataclass_fields__:
            continue  # a group of files
        first, *others = explain(key).splitlines()
        assert re.fullmatch(rf"{re.escape(key)}(=\S.*)?", first)
        is_group = first == key
        assert is_group or re.match(r"  \S.{9}", others[0]), key
