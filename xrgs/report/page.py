"""The report of a sweep, made from the store alone: the same store gives the same bytes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.evaluation.metrics import METRICS
from xrgs.experiment.store import Store
from xrgs.report.collect import RECORD_KEYS, ReportError, Sweep, read_sweep
from xrgs.report.compare import compare
from xrgs.report.pictures import Picture, draw
from xrgs.report.render import Grid, markdown, to_latex, to_markdown, to_text
from xrgs.report.tables import Tables
from xrgs.report.training import table as training_table
from xrgs.report.training import totals
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.untrusted import one_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

#: A terminal shows the ablations one by one up to this many; the overview and files have all.
_MOST_ON_TERMINAL = 6
_MOST_MISSING_ON_TERMINAL = 20
#: What training time depends on beside the program.
_MACHINE = ("cpu", "threads", "backend")
_MADE_WITH = ("xrgs", "git", "git_diff_sha256", "python", "packages.torch", "platform", *_MACHINE)


@dataclass(frozen=True)
class Report:
    """What `build` made."""

    text: str
    """For the terminal, with the folder's name at the end."""
    folder: Path
    files: tuple[Path, ...]
    """Everything written, sorted."""


def build(
    store_path: Path,
    sweep_id: str | None = None,
    out: Path | None = None,
    pictures: Sequence[str] | None = None,
) -> Report:
    """Write tables, scores and figures of a sweep.

    Args:
        store_path: the store's folder.
        sweep_id: the sweep; the latest one where none is given.
        out: folder to write to; `<store>/reports/<sweep id>` where none is given.
        pictures: names of those that are wanted (`draw`); None for all.

    Raises:
        StoreError: the store holds no such sweep.
        ReportError: the sweep's cells can't be compared, there is no picture of such a name, or
            `out` can't be written.
    """
    store = Store(store_path)
    sweep_id = sweep_id or store.latest_sweep()
    sweep = read_sweep(store, sweep_id, METRICS)
    comparison = compare(sweep.cells, METRICS)
    tables = Tables(comparison)
    folder = out or store.reports / sweep_id
    links = [place for place in (folder, folder / "figures") if place.is_symlink()]
    if links and out is None:
        raise ReportError(f"{links[0]} is a link: remove it, or name a folder with out=...")
    try:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
        drawn = draw(store, comparison, sweep.views, folder / "figures", pictures)
        _write_files(folder, sweep, tables, drawn, totals(store, comparison.cells))
    except OSError as error:
        raise ReportError(f"the report can't be written to {folder}: {error}") from error
    written = {p.file for p in drawn if p.file} | {folder / name for name in _FILES}
    text = _text(tables, _warnings(sweep)) + f"\nWritten to {folder}"
    return Report(text=text, folder=folder, files=tuple(sorted(written)))


_FILES = (
    "table.md",
    "table.tex",
    "table.csv",
    "cells.csv",
    "views.csv",
    "training.csv",
    "provenance.json",
)


def _write_files(
    folder: Path,
    sweep: Sweep,
    tables: Tables,
    pictures: list[Picture],
    training: pd.DataFrame,
) -> None:
    cells = tables.comparison.cells
    names = cells.drop_duplicates("cell_id")[["cell_id", "scene", "label", "condition", "seed"]]
    views = names.merge(sweep.views, on="cell_id")
    metrics = [metric.name for metric in tables.comparison.metrics]
    order = [*RECORD_KEYS, "state", "reason", "protocol", *metrics]
    write_text(folder / "table.md", _page(sweep, tables, pictures, folder, training))
    grids = [grid for grid in _grids(tables) if grid.rows]
    write_text(folder / "table.tex", "\n".join(map(to_latex, grids)))
    write_text(folder / "table.csv", _csv(tables.long()))
    write_text(folder / "cells.csv", _csv(cells[order]))
    write_text(folder / "views.csv", _csv(views))
    write_text(folder / "training.csv", _csv(training))
    write_json(folder / "provenance.json", sweep.provenance)


def _csv(table: pd.DataFrame) -> str:
    return str(table.to_csv(index=False, lineterminator="\n"))


def _grids(tables: Tables) -> list[Grid]:
    """Every table, the widest view first."""
    comparison = tables.comparison
    grids = tables.overviews()
    for group in comparison.groups:
        grids.append(tables.mean(*group))
        if len(comparison.scenes) > 1:
            grids.append(tables.per_scene(*group))
    grids += [tables.values(name) for name in dict.fromkeys(comparison.cells["condition"])]
    missing = tables.missing()
    return grids + ([missing] if missing else [])


def _training(tables: Tables, training: pd.DataFrame) -> list[Grid]:
    """What training did, for each condition."""
    cells = tables.comparison.cells
    labels = cells.groupby("condition", sort=False)["label"].unique()
    return [training_table(training, list(of), str(name)) for name, of in labels.items()]


def _page(
    sweep: Sweep,
    tables: Tables,
    pictures: list[Picture],
    folder: Path,
    training: pd.DataFrame,
) -> str:
    command = one_line(shlex.join(["xrgs-sweep", *sweep.command]))
    parts = [
        f"# Change from baseline\n\nSweep {markdown(sweep.id)}: {markdown(command)}\n",
        *(f"**{markdown(line)}**\n" for line in _warnings(sweep)),
        *(to_markdown(grid) for grid in _grids(tables) if grid.rows),
        *(to_markdown(grid) for grid in _training(tables, training) if grid.rows),
        *(_picture(picture, folder) for picture in pictures),
        to_markdown(_made_with(sweep)),
    ]
    return "\n".join(parts)


def _picture(picture: Picture, folder: Path) -> str:
    title = markdown(picture.title)
    if picture.file is None:
        return f"No picture of {title}: {markdown(picture.why)}\n"
    return f"![{title}]({picture.file.relative_to(folder).as_posix()})\n\n{title}\n"


def _made_with(sweep: Sweep) -> Grid:
    rows = tuple((key, "; ".join(sweep.provenance.get(key, ["n/a"]))) for key in _MADE_WITH)
    return Grid("Made with", ("", "values"), rows, "ll")


def _warnings(sweep: Sweep) -> list[str]:
    mixed = [key for key in _MACHINE if len(sweep.provenance.get(key, ())) > 1]
    if not mixed:
        return []
    return [f"The cells differ in {', '.join(mixed)}: their training times do not compare."]


def _text(tables: Tables, warnings: list[str]) -> str:
    """What a command prints."""
    comparison = tables.comparison
    grids = tables.overviews()
    if len(comparison.groups) <= _MOST_ON_TERMINAL:
        for group in comparison.groups:
            grids.append(tables.mean(*group))
            if len(comparison.scenes) > 1:
                grids.append(tables.per_scene(*group))
    if not comparison.groups:
        grids += [tables.values(name) for name in dict.fromkeys(comparison.cells["condition"])]
    missing = tables.missing()
    if missing:
        more = len(missing.rows) - _MOST_MISSING_ON_TERMINAL
        notes = (f"and {more} more, in table.md",) if more > 0 else ()
        grids.append(replace(missing, rows=missing.rows[:_MOST_MISSING_ON_TERMINAL], notes=notes))
    return "\n".join([*(to_text(grid) for grid in grids if grid.rows), *warnings])
