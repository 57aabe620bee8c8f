"""The runs of a race as a file, as tables and as a picture."""

from __future__ import annotations

import itertools
import math
import os
import re
import sys
from dataclasses import dataclass, fields
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure

from xrgs.report.figures import png
from xrgs.report.inference import difference, half_width, log_ratio
from xrgs.report.markup import to_markdown
from xrgs.report.writing import interval, signed
from xrgs.runtime.text import TextTable
from xrgs.safeio.atomic import atomic_writer, write_text
from xrgs.safeio.records import read_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

RUNS = "race.csv"
SCORES = ("psnr", "ssim", "lpips")
#: A race counts only if other programs used at most this many cores meanwhile; our choice.
QUIET = 0.1
#: Type of a field of `Run` -> the function that converts a text of the file.
_KINDS = {"int": int, "float": float, "str": str}
_MEANS = ("steps", "seconds", "gaussians", "psnr", "lpips")
_PANELS = {"psnr": "PSNR, dB", "lpips": "LPIPS"}
_MARKS = "os^DvPX*"
_PLACE = re.compile(r"(?<=<!-- race -->\n).*(?=<!-- end of the race -->)", re.DOTALL)


@dataclass(frozen=True)
class Run:
    """A row of `race.csv`."""

    size: int
    """The longer side of an HR photograph, px."""
    scene: str
    arm: str
    minutes: float
    """The budget for which the run was planned, or for which it helped to plan another."""
    steps: int
    seconds: float
    """Seconds of training, without loading, writing and scoring."""
    psnr: float
    ssim: float
    lpips: float
    """Means over the test views (also psnr, dB, and ssim); lpips is NaN without its weights."""
    gaussians: int
    bytes: int
    """The size of the .ply file."""
    others: float
    """Mean number of cores that other programs used during the run."""
    machine: str
    program: str
    cell: str = ""
    """The id of our cell; empty for OpenSplat."""


def read(folder: Path) -> list[Run]:
    """Read the runs of a race; none if it has not begun.

    Raises:
        StoreError: The file is damaged.
    """
    if not (folder / RUNS).exists():
        return []
    header, rows = read_table(folder / RUNS)
    kinds = {field.name: _KINDS[str(field.type)] for field in fields(Run)}
    return [
        Run(**{name: kinds[name](text) for name, text in zip(header, row, strict=True)})
        for row in rows
    ]


def line(run: Run) -> str:
    """Describe a run in one line."""
    where = f"{run.size} px, {run.scene}, {run.arm}"
    speed = f"{run.steps} steps in {run.seconds:.1f} s of {60 * run.minutes:.0f}"
    scores = f"{run.psnr:.2f} dB, LPIPS {run.lpips:.3f}, {run.gaussians} Gaussians"
    return f"{where}: {speed}: {scores}; other programs took {run.others:.2f} cores"


def chosen(runs: Sequence[Run], size: int, minutes: float) -> dict[tuple[str, str], Run]:
    """Return (arm, scene) -> the longest run within a budget, of the scenes raced for it."""
    scenes = {run.scene for run in runs if (run.size, run.minutes) == (size, minutes)}
    within = [
        run
        for run in runs
        if run.size == size and run.scene in scenes and run.seconds <= 60 * minutes
    ]
    return {(run.arm, run.scene): run for run in sorted(within, key=lambda run: run.seconds)}


def budgets(runs: Sequence[Run]) -> list[tuple[int, float]]:
    """Return the (size, minutes) of a race, in order."""
    return sorted({(run.size, run.minutes) for run in runs})


def write(folder: Path, page: Path | None, against: str) -> None:
    """Write tables and a picture of a race, and put the tables into a page.

    Args:
        folder: The folder of the race.
        page: A Markdown page with the two `race` comments; None for no page.
        against: The arm that others are compared with; empty for OpenSplat or, if it was not run,
            the baseline.

    Raises:
        SystemExit: The race has no run, or the page lacks the comments.
    """
    runs = read(folder)
    if not runs:
        raise SystemExit(f"{folder}: no race, {RUNS} is missing")
    base = against or ("opensplat" if any(run.arm == "opensplat" for run in runs) else "baseline")
    texts = [to_markdown(table(runs, *budget, base)) for budget in budgets(runs)]
    text = "\n".join((*texts, "\n".join(notes(runs))))
    write_text(folder / "table.md", f"{text}\n")
    picture = folder / "race.png"
    with atomic_writer(picture) as stream, style.context("default"):
        stream.write(png(figure(runs)))
    if page is not None:
        content = page.read_text(encoding="utf-8")
        shown = f"![Quality over minutes]({os.path.relpath(picture, page.parent)})\n\n{text}\n"
        filled, places = _PLACE.subn(lambda _: shown, content)
        if places != 1:
            raise SystemExit(f"{page}: it must have one place for a race, it has {places}")
        write_text(page, filled)
    sys.stdout.write(text + "\n")


def table(runs: Sequence[Run], size: int, minutes: float, base: str) -> TextTable:
    """Make the table of a budget.

    Args:
        runs: All runs.
        size: The longer side of an HR photograph, px.
        minutes: The budget.
        base: The arm that others are compared with.
    """
    longest = chosen(runs, size, minutes)
    rows = []
    for arm in dict.fromkeys(run.arm for run in runs if run.size == size):
        arm_runs = [run for (name, _), run in longest.items() if name == arm]
        if not arm_runs:
            rows.append((arm, "0", *[""] * 7))
            continue
        mean = {name: fmean(getattr(run, name) for run in arm_runs) for name in _MEANS}
        scores = (f"{mean['psnr']:.2f}", f"{mean['lpips']:.3f}")
        counts = (f"{mean[name]:,.0f}" for name in ("steps", "seconds", "gaussians"))
        changes = (_change(longest, arm, base, score) for score in ("psnr", "lpips"))
        rows.append((arm, str(len(arm_runs)), *counts, *scores, *changes))
    return TextTable(
        title=f"{minutes:g} min of training, {size} px",
        columns=(
            *("arm", "scenes", "steps", "seconds", "Gaussians", "PSNR, dB", "LPIPS"),
            *(f"PSNR from {base}, dB", f"LPIPS from {base}, %"),
        ),
        rows=tuple(rows),
        align="lrrrrrrll",
    )


def _change(longest: Mapping[tuple[str, str], Run], arm: str, base: str, score: str) -> str:
    """Write the mean change of a score over scenes, its 95 % interval, and how many improve."""
    scenes = [scene for name, scene in longest if name == arm and (base, scene) in longest]
    if arm == base or not scenes:
        return ""
    values = [
        np.array([getattr(longest[name, scene], score) for scene in scenes]) for name in (base, arm)
    ]
    is_ratio = score == "lpips"
    changes, _ = (log_ratio if is_ratio else difference)(*values)
    n = len(changes)
    mean = changes.mean()
    half = half_width(changes.std(ddof=1), np.array(n)) if n > 1 else math.nan
    shown = np.array([mean, mean - half, mean + half])
    shown = 100 * np.expm1(shown) if is_ratio else shown
    better = int((changes < 0).sum() if is_ratio else (changes > 0).sum())
    around = f" ({interval(*shown[1:])})" if n > 1 else ""
    return f"{signed(shown[0])}{around}, better on {better} of {n}"


def notes(runs: Sequence[Run]) -> list[str]:
    """Return Markdown lines on machine, programs and averages, for the reader of the tables."""
    programs = ", ".join(dict.fromkeys(run.program for run in runs))
    lines = [
        f"- {runs[0].machine}; {programs}.",
        "- Means over scenes of the longest run within the budget. In brackets: the 95 % interval"
        " (Student's t) of the change over scenes.",
    ]
    if not any(run.arm.startswith("opensplat") for run in runs):
        lines.append("- OpenSplat was not run.")
    counted = [run for budget in budgets(runs) for run in chosen(runs, *budget).values()]
    others = max((run.others for run in counted), default=0.0)
    if others > QUIET:
        lines.append(f"- **No result:** other programs used up to {others:.1f} cores meanwhile.")
    return lines


def figure(runs: Sequence[Run]) -> Figure:
    """Draw PSNR and LPIPS over minutes, a row of panels for each size."""
    sizes = sorted({size for size, _ in budgets(runs)})
    drawn = Figure(figsize=(11, 4.2 * len(sizes)), dpi=150, layout="constrained")
    panels = drawn.subplots(len(sizes), 2, squeeze=False)
    for row, size in zip(panels, sizes, strict=True):
        for axes, (score, name) in zip(row, _PANELS.items(), strict=True):
            _draw(axes, runs, size, score)
            axes.set(title=f"{size} px", xlabel="minutes of training on two cores", ylabel=name)
    handles = {
        text: line
        for axes in panels.flat
        for line, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    drawn.legend(handles.values(), handles.keys(), loc="outside right upper")
    return drawn


def _draw(axes: Axes, runs: Sequence[Run], size: int, score: str) -> None:
    """Draw every run of a size, also those that only helped to plan others: a line a scene."""
    arms = dict.fromkeys(run.arm for run in runs if run.size == size)
    for (number, arm), mark in zip(enumerate(arms), itertools.cycle(_MARKS)):
        arm_runs = sorted(
            (run for run in runs if (run.size, run.arm) == (size, arm)),
            key=lambda run: (run.scene, run.seconds),
        )
        for scene, scene_runs in itertools.groupby(arm_runs, key=lambda run: run.scene):
            points = [(run.seconds / 60, getattr(run, score)) for run in scene_runs]
            label = arm if scene == arm_runs[0].scene else None
            axes.plot(*zip(*points, strict=True), f"C{number}", marker=mark, ms=4, label=label)
    axes.set_xlim(left=0)
