"""`benchmarks/race.py`: its plans, what it reads of OpenSplat, its statistics, and a whole race."""

from __future__ import annotations

import csv
import importlib
import math
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy import stats
from skimage.metrics import peak_signal_noise_ratio

from xrgs.composing import compose
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.training.dataset import LoadedView

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
STAND_IN = Path(__file__).with_name("opensplat_stand_in.py")


@pytest.fixture
def race(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("race")


def made(race: Any, **values: Any) -> Any:
    run = race.Run(500, "fern", "plus", 1.0, 200, 5.0, 20.0, 0.7, 0.3, 9, 99, 0.0, "m", "p")
    return replace(run, **values)


@pytest.mark.parametrize("power", [0.8, 1.4])
def test_a_run_is_planned_to_fit_each_budget(race: Any, power: float) -> None:
    runs: list[Any] = []
    for minutes in (1.0, 3.0, 10.0):
        before = len(runs)
        while steps := race.plan(runs, minutes):
            seconds = 4.0 * (steps / 200) ** power
            runs.append(made(race, steps=steps, seconds=seconds, minutes=minutes))
            assert seconds < 1.6 * 60 * minutes
        assert 0.85 * 60 * minutes <= max(r.seconds for r in runs if r.seconds <= 60 * minutes)
        assert len(runs) - before <= 4


def test_after_some_tries_the_longest_run_within_a_budget_has_to_do(race: Any) -> None:
    seconds = iter([5.0, 70.0, 40.0, 61.0])  # another program disturbs them
    runs: list[Any] = []
    while steps := race.plan(runs, 1.0):
        runs.append(made(race, steps=steps, seconds=next(seconds)))
    assert [run.seconds for run in runs] == [5.0, 70.0, 40.0, 61.0]
    assert race.race_table.chosen(runs, 500, 1.0)["plus", "fern"].seconds == 40.0
    with pytest.raises(SystemExit, match=r"fern / plus: 0\.01 min are less than a step takes"):
        race.plan([made(race, steps=1, seconds=2.0)], 0.01)


def test_a_scene_that_was_not_raced_for_a_budget_is_not_in_its_table(race: Any) -> None:
    runs = [made(race, scene="horns"), made(race), made(race, minutes=3.0, seconds=150.0)]
    assert race.race_table.chosen(runs, 500, 3.0) == {("plus", "fern"): runs[2]}
    assert len(race.race_table.chosen(runs, 500, 1.0)) == 2


def test_time_that_writing_takes_does_not_count(race: Any, tmp_path: Path) -> None:
    lines: list[tuple[float, str]] = [(0.0, "Using CPU"), (9.0, "Loading a.png")]
    now = 10.0
    for step in range(1, 100):
        lines.append((now, f"Step {step}: 0.2 (0%)"))
        if step % 5 == 0:
            file = tmp_path / f"splat_{step}.ply"
            file.write_text("")
            now += 7.0
            lines.append((now, f"Wrote {file}"))
        now += 1.0
    kept = race.opensplat.snapshots(lines, [12.0, 30.5, 3.0])
    assert {limit: (one.steps, one.seconds) for limit, one in kept.items()} == {
        12.0: (10, 9.0),  # step 15 ends 14 s after the first
        30.5: (30, 29.0),
    }
    assert {file.name for file in tmp_path.iterdir()} == {"splat_10.ply", "splat_30.ply"} | {
        f"splat_{step}.ply" for step in range(35, 100, 5)
    }, "what is written later is none of its files"


def test_runs_are_read_as_they_were_written(race: Any, tmp_path: Path) -> None:
    runs = [made(race, lpips=math.nan, machine="AMD, 2 cores"), made(race, cell="0123")]
    table = race.table_text([race.asdict(run) for run in runs])
    (tmp_path / "race.csv").write_text(table)
    assert repr(race.race_table.read(tmp_path)) == repr(runs)
    assert race.race_table.read(tmp_path / "none") == []


def test_the_committed_race_makes_its_table_again(race: Any, tmp_path: Path) -> None:
    committed = BENCHMARKS.parent / "reports" / "race"
    shutil.copy(committed / "race.csv", tmp_path)
    race.race_table.write(tmp_path, None, "")
    table = (committed / "table.md").read_text()
    assert (tmp_path / "table.md").read_text() == table
    assert table in (BENCHMARKS.parent / "docs" / "speed.md").read_text()


def test_programs_that_disturb_only_runs_that_are_not_counted_are_no_matter(race: Any) -> None:
    probe, counted = made(race, others=0.5), made(race, steps=900, seconds=50.0, others=0.05)
    assert "No result" not in "\n".join(race.race_table.notes([probe, counted]))
    disturbed = replace(counted, others=0.5)
    assert "up to 0.5 cores" in "\n".join(race.race_table.notes([probe, disturbed]))


def scenes(race: Any, arm: str, psnr: Iterable[float], lpips: Iterable[float]) -> list[Any]:
    return [
        made(race, arm=arm, scene=f"scene{number}", psnr=p, lpips=q)
        for number, (p, q) in enumerate(zip(psnr, lpips, strict=True))
    ]


def test_changes_have_students_interval_over_scenes(race: Any) -> None:
    base, arm = np.array([20.0, 22.0, 25.0, 24.0]), np.array([21.5, 22.4, 26.0, 23.8])
    lpips = np.array([0.3, 0.2, 0.1, 0.25]), np.array([0.2, 0.21, 0.05, 0.2])
    runs = [*scenes(race, "opensplat", base, lpips[0]), *scenes(race, "plus", arm, lpips[1])]
    table = race.race_table.table(runs, 500, 1.0, "opensplat")
    low, high = stats.t.interval(0.95, 3, np.mean(arm - base), stats.sem(arm - base))
    (_, *_, of_base), row = table.rows
    assert of_base == ""
    assert row[:2] == ("plus", "4")
    assert row[-2] == f"+0.67 ({low:+.2f} to {high:+.2f}), better on 3 of 4"
    logs = np.log(lpips[1] / lpips[0])
    low, high = np.expm1(stats.t.interval(0.95, 3, logs.mean(), stats.sem(logs)))
    change = 100 * np.expm1(logs.mean())
    assert row[-1] == f"{change:+.2f} ({100 * low:+.2f} to {100 * high:+.2f}), better on 3 of 4"


@pytest.mark.slow
def test_a_busy_machine_gives_no_result(race: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Speed\n<!-- race -->\nold\n<!-- end of the race -->\nmore\n")
    runs = [
        *scenes(race, "plus", [20, 21], [0.1, 0.2]),
        *scenes(race, "baseline", [19, 19], [1, 1]),
    ]
    runs[0] = replace(runs[0], others=1.26)
    (tmp_path / "race.csv").write_text(race.table_text([race.asdict(run) for run in runs]))
    race.race_table.write(tmp_path, page, "")
    text = (tmp_path / "table.md").read_text()
    assert "**No result:** other programs used up to 1.3 cores meanwhile." in text
    assert "OpenSplat was not run." in text
    assert page.read_text() == (
        "# Speed\n<!-- race -->\n![Quality over minutes](race.png)\n\n"
        f"{text}<!-- end of the race -->\nmore\n"
    )
    with Image.open(tmp_path / "race.png") as picture:
        assert picture.size == (1650, 630)
    with pytest.raises(SystemExit, match="it has 0"):
        race.race_table.write(tmp_path, tmp_path / "table.md", "")


def test_a_pixel_without_gaussians_has_opensplats_background(race: Any, tmp_path: Path) -> None:
    photograph = np.random.default_rng(0).integers(0, 256, (24, 32, 3)).astype(np.uint8)
    K = torch.tensor([[30.0, 0, 19], [0, 30, 12], [0, 0, 1]])
    view = LoadedView("a", "HR", Camera(torch.eye(4), K, 32, 24), torch.from_numpy(photograph))
    nothing = Gaussians(
        *(torch.zeros(1, *shape) for shape in ((3,), (4,), (3,), (), (1, 3), (15, 3)))
    )
    nothing.quats.fill_(1.0)
    scores = race.opensplat.score(nothing, [view], compose().splat, tmp_path / "renders")
    background = np.broadcast_to(np.array([0.6130, 0.0101, 0.3984], np.float32), (24, 32, 3))
    expected = peak_signal_noise_ratio(photograph / 255, background, data_range=1)
    assert scores["psnr"] == pytest.approx(expected, rel=1e-6)


@pytest.mark.exhaustive  # minutes, for a script outside the package
def test_a_race_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    peer = tmp_path / "opensplat"
    peer.write_text(f'#!/bin/sh\nexec {sys.executable} {STAND_IN} "$@"\n')
    peer.chmod(0o755)
    command = [
        *(sys.executable, str(BENCHMARKS / "race.py"), "race", "variant.sfm.long_side=500"),
        *("--sizes", "250", "--scenes", "procedural", "--arms", "baseline"),
        *("--probe-steps", "10", "--opensplat", str(peer)),
    ]

    def run(*minutes: str) -> list[dict[str, str]]:
        words = [*command, "--minutes", *minutes]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        with (tmp_path / "race" / "race.csv").open() as file:
            return list(csv.DictReader(file))

    first = run("0.05")
    assert {row["arm"] for row in first} == {"baseline", "opensplat", "opensplat_planned"}
    assert run("0.05") == first, "all budgets have their runs"
    both = run("0.05", "0.1")
    assert both[: len(first)] == first
    folder = tmp_path / "race" / "opensplat" / "250"
    images = pycolmap.Reconstruction(folder / "data" / "procedural" / "sparse" / "0").images
    [variant] = (tmp_path / "race" / "store" / "variants").glob("*-*")
    views = {f.stem for f in (variant / "images" / "train").iterdir()}
    assert {image.name.removesuffix(".png") for image in images.values()} == views
    row = next(row for row in both if row["arm"] == "opensplat" and row["minutes"] == "0.1")
    assert 0 < float(row["seconds"]) <= 6
    psnr = [
        peak_signal_noise_ratio(
            np.asarray(Image.open(variant / "images" / "test" / file.name)),
            np.asarray(Image.open(file)),
        )
        for file in (folder / "opensplat-0.1min" / "procedural").glob("*.png")
    ]
    assert float(row["psnr"]) == pytest.approx(np.mean(psnr), abs=0.05)
