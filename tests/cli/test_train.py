"""Tests of `xrgs-train`: what it chooses and says, and one scene that is really made."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import composed_by_hydra
from xrgs import composing
from xrgs.bench.speed import Trial
from xrgs.cli import sweep, train
from xrgs.photos.scenes import motorcycle
from xrgs.store.cell_folder import CellFolder
from xrgs.store.inspect import RECIPE, SfmReport
from xrgs.store.store import Store

RunCommand = Callable[..., tuple[int, str, str]]
ACCENT = "e\N{COMBINING ACUTE ACCENT}"


@pytest.fixture
def handed_over(
    call_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., dict[str, str]]:
    """The overrides that a sweep gets for some arguments, once the photographs are placed."""

    def run(*arguments: str) -> dict[str, str]:
        words: list[str] = []
        found = train._Placed("0123-4567", SfmReport())
        monkeypatch.setattr(train, "_place", lambda _: found)
        monkeypatch.setattr(composing, "compose", composed_by_hydra)
        monkeypatch.setattr(train, "_measured_unit", lambda _: 1e-7)
        monkeypatch.setattr("xrgs.sweep.estimate.units_of_a_step", lambda *_: 1e5)
        monkeypatch.setattr(train, "_trial", lambda *_: Trial(start_s=0.0, step_s=0.01))
        monkeypatch.setattr(train, "_say_end", lambda *_: None)
        monkeypatch.setattr(train, "_cell", lambda *_: CellFolder(Path("absent")))
        monkeypatch.setattr(sweep, "run", lambda _, of, __: words.extend(of))
        code, _, err = call_command("train", *arguments)
        assert code == 0, err
        return {key.lstrip("+"): value for key, _, value in (w.partition("=") for w in words)}

    return run


@pytest.fixture
def garden(photographs: Callable[..., Path], tmp_path: Path) -> Path:
    """A folder with nine photographs, in the folder in which commands run."""
    return photographs(tmp_path / "garden", 9)


@pytest.mark.slow
@pytest.mark.usefixtures("garden")
def test_the_default_is_the_recipe_on_the_photographs_as_they_are(
    handed_over: Callable[..., dict[str, str]],
) -> None:
    chosen = handed_over("garden")
    expected = {"ablation": RECIPE, "scene.path": "garden", "baseline": "false"}
    expected |= {"preset": "laptop", "splat.densify.every": "500"}  # as preset=laptop has it
    expected |= {"variant": "sampling_rate", "variant.factor": "1"}  # as they are
    assert expected.items() <= chosen.items()
    words = handed_over("garden", "--recipe", "baseline")
    assert not {"ablation", "baseline"} & words.keys(), "gsplat's own training"
    words = handed_over("garden", "--quality", "high")
    assert {"preset": "paper", "train.evaluate_every": "0"}.items() <= words.items()
    assert "splat.densify.every" not in words, "a long run is refined as the paper's"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--recipe", "plus,exposure", "--all"],
         {"ablation": "[plus,exposure]", "variant.test_every": "0"}),
        (["--quality=draft"], {"train.steps": "1000", "variant.long_side": "336"}),
        (["train.steps=100"], {"splat.densify.every": "15000"}),
        (["train.steps=100", "splat.densify.every=7"], {"splat.densify.every": "7"}),
        (["size=250", "--quality", "draft", "all=true"],
         {"variant.long_side": "250", "train.steps": "1000", "variant.test_every": "0"}),
        (["--masks", "m", "+ablation=mcmc"], {"scene.masks": "m", "ablation": "mcmc"}),
        (["preset=paper", "store=other"], {"preset": "paper", "store": "other"}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)  # fmt: skip
@pytest.mark.usefixtures("garden")
def test_options_are_overrides_and_those_of_the_user_win(
    handed_over: Callable[..., dict[str, str]], arguments: list[str], expected: dict[str, str]
) -> None:
    words = handed_over("garden", *arguments)
    assert expected.items() <= words.items()


@pytest.mark.slow
@pytest.mark.usefixtures("garden")
@pytest.mark.parametrize(
    ("minutes", "more"),
    [("1", ["--all", "--masks", "m", "--store", "my store", "seed=3"]),
     ("10", ["--recipe", "lean"])],
)  # fmt: skip
def test_the_command_that_minutes_prints_makes_the_same_cell(
    handed_over: Callable[..., dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    minutes: str,
    more: list[str],
) -> None:
    said: list[str] = []
    monkeypatch.setattr(train, "_say", said.append)
    chosen = handed_over("garden", "--minutes", minutes, *more)
    if minutes == "10":  # a step takes 10 ms; 600 s are for more than the most steps
        assert (chosen["train.steps"], chosen["preset"]) == ("30000", "paper")
    else:
        assert 3000 < int(chosen["train.steps"]) < 6000
        assert chosen["preset"] == "laptop"
    (line,) = (line for line in said if line.startswith(f"chosen for {minutes} min; "))
    again = shlex.split(line.partition(": ")[2])
    assert again[:2] == ["xrgs-train", "garden"]
    assert "--minutes" not in again
    assert handed_over(*again[1:]) == chosen


@pytest.mark.slow
@pytest.mark.usefixtures("garden")
def test_the_user_may_replace_what_minutes_choose(
    handed_over: Callable[..., dict[str, str]],
) -> None:
    fixed = handed_over("garden", "--minutes", "10", "train.steps=5", "--size", "99")
    assert (fixed["train.steps"], fixed["variant.long_side"]) == ("5", "99")


def test_more_time_gives_larger_views_and_more_steps_and_never_exceeds_the_time() -> None:
    for unit in (1e-8, 1e-7, 1e-6):
        sizes = [train.size_for(60.0 * minutes, unit) for minutes in (1, 5, 20, 60, 600)]
        assert sizes == sorted(sizes)
    steps = [train.steps_for(seconds, 0.05) for seconds in (60, 300, 1200)]
    assert steps == sorted(steps)
    for seconds, count in zip((60, 300, 1200), steps, strict=True):
        assert 0.7 * seconds - 15 < 0.05 * count < seconds
    assert train.steps_for(1, 0.05) == 200  # too little time for anything: the fewest


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["gone"], "gone: there is no such folder or video"),
        (["garden/0.png"], "garden/0.png: is a photograph; name the folder that it is in"),
        (["garden", "seed=0,1"], "seed=0,1: give one value; xrgs-sweep takes several"),
        (["garden", "--minutes", "0"], "--minutes 0: must be above 0"),
        (["garden", "--minutes", "5", "--quality", "high"], "without --quality"),
        (["garden", "--out", "a.obj"], "--out a.obj: a file ends with .ply, .glb, .spz"),
        (["garden", "two"], "two: write KEY=VALUE, as seed=1; one folder of photographs is taken"),
        (["garden", "--recipe", "plus,nice"], "ablation=nice: there is no such choice"),
        (["garden", "--recipe", "nice", "--dry-run"], "ablation=nice: there is no such choice"),
        (["garden", "--out", "garden"], "--out garden: is not empty; name a new folder"),
        (["garden", "--out", "a_file"], "--out a_file: is a file; name a new folder"),
        (["garden", "--out", "a_file/b/c.ply"], "a_file: Not a directory"),
        (["garden", "--out", "a_file/b"], "--out a_file/b: can't be written: "),
        (["garden", "--out", "/proc/none/a.glb"], "--out /proc/none/a.glb: can't be written: "),
        (["garden", "--out", "two.ply"], "--out two.ply: is a folder; name a file"),
        (["garden", "--store", "a_file", "--dry-run"], "store=a_file can't be written (Not a dir"),
        (["two"], "scene two: 2 photographs are too few: 1 is held out to test on"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
@pytest.mark.usefixtures("garden")
def test_what_cant_be_done_is_said_before_anything_is(
    call_command: RunCommand,
    photographs: Callable[..., Path],
    tmp_path: Path,
    arguments: list[str],
    message: str,
) -> None:
    photographs(tmp_path / "two", 2)
    (tmp_path / "two.ply").mkdir()
    (tmp_path / "a_file").touch()
    code, _, err = call_command("train", *arguments)
    assert code == 1
    assert message in err
    assert err.startswith("xrgs-train: ") or arguments == ["two"]
    assert not list(tmp_path.glob("xrgs-store/cells/*"))


@pytest.mark.usefixtures("garden")
def test_a_dry_run_says_how_many_photographs_there_are_and_writes_nothing(
    call_command: RunCommand, garden: Path, tmp_path: Path
) -> None:
    (garden / "damaged.png").write_bytes(b"no image")
    code, out, err = call_command("train", "garden", "--dry-run")
    assert code == 0, err
    assert out.splitlines()[0] == "garden: 10 photographs found"
    assert "left out: damaged.png" in out
    assert "9 photographs: 2 held out, 7 to train on, as they are\n" in out
    assert not (tmp_path / "xrgs-store").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_a_scene_with_odd_names_is_made_and_its_last_lines_lead_on(
    call_command: RunCommand, tmp_path: Path
) -> None:
    folder = tmp_path / f"部屋 🙂 {{it's}} 50%=#1; {ACCENT}, a"
    folder.mkdir()
    views = ['-a b\'s & "c" (1) 🙂', f"[{ACCENT}]=50%#, $x.y"]
    for name, file in zip(views, motorcycle.files().values(), strict=True):
        shutil.copy(file, folder / f"{name}.png")
    store = "st öre, 'a' {b} 🙂"
    given = (folder.name, "--all", "--size", "250", "train.steps=8", "--store", store)
    small = (*given, "variant.sfm.long_side=500")
    code, out, err = call_command("train", *small)
    assert code == 0, err
    lines = out.splitlines()
    assert lines[0] == f"{folder.name}: 2 photographs found"
    end = lines[-8:]
    assert end[0] == f"{folder.name}: 2 of 2 photographs are placed"
    assert end[1].endswith(" dB on 2 photographs that it was trained on")
    assert "Gaussians after 8 steps; all took " in end[2]
    page = tmp_path / end[3].removeprefix("Page: ")
    assert page.name == "report.html"
    assert page.is_file()
    assert end[4] == "Next:"
    quoted = f"{shlex.quote(folder.name)} --store {shlex.quote(store)}"
    assert end[5] == f"  xrgs-view {quoted}"
    assert end[7].startswith("  xrgs-data export ")
    assert "plan:" not in err  # a study's words
    (cell,) = Store(tmp_path / store).cell_folders()
    assert cell.state().name == "done"
    assert {file.stem for file in (cell.path / "renders").iterdir()} == set(views)

    code, out, err = call_command("train", *small, "--out=a.ply")
    assert code == 0, err  # found again, and exported by its name
    assert "training" not in err + out
    assert f"trained already by {RECIPE}: 8 steps at 250 px\n" in out
    assert out.splitlines()[-1].endswith("written to a.ply")
    export = ("export", folder.name, "--out", "b.ply", "--store", store)
    assert call_command("data", *export)[0] == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert folder.name in call_command("status", "--store", store)[1]


@pytest.mark.slow
def test_a_cell_that_fails_is_named_with_the_reason(sweep_here: RunCommand, children: Any) -> None:
    children.failures = {0: "it raised"}
    arguments = ("scene=motorcycle", "preset=smoke", "store=s", "hydra.sweeper.brief=true")
    code, out, err = sweep_here(*arguments)
    assert (code, out) == (1, "")
    assert re.search(r"^  failed .* motorcycle / .* / seed 0  \(it raised\)$", err, re.MULTILINE)
