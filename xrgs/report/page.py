"""Writes the report of a sweep, which depends only on the store: the same store, the same bytes."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pandas as pd

from xrgs.evaluation.metrics import METRICS
from xrgs.mixture.paths import TO_TRY
from xrgs.report import curves, work
from xrgs.report.collect import (
    CELL_KEYS,
    RECORD_KEYS,
    Choice,
    ReportError,
    ReportStore,
    Sweep,
    read_cells,
    report_name,
)
from xrgs.report.compare import Comparison, Design, compare
from xrgs.report.context import contexts, decided_by_one_view, photographs, with_variants
from xrgs.report.external import External, with_external
from xrgs.report.html import write_document
from xrgs.report.markup import latex_file, to_markdown
from xrgs.report.mixed import fewer_replicates, other_code, other_settings
from xrgs.report.paper import paper_tables, texture_tables, why_no_table, with_texture
from xrgs.report.pictures import Picture, draw
from xrgs.report.tables import Tables
from xrgs.report.writing import legend
from xrgs.runtime.text import TextTable, to_text
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.sanitize import counted, for_csv, for_file_name, for_line, for_markdown
from xrgs.store.provenance import MACHINE_KEYS, without_threads
from xrgs.store.scoring import PROTOCOL
from xrgs.store.store import BASELINE

#: The page of a report.
PAGE = "report.html"
#: Up to this many ablations are printed with tables of their own; the files have all.
_MAX_PRINTED_ABLATIONS = 6
_MAX_PRINTED_MISSING = 20
_PROVENANCE_KEYS = (
    "xrgs",
    "git",
    "git_diff_sha256",
    "python",
    "packages.torch",
    "platform",
    "arithmetic",
    *MACHINE_KEYS,
)


@dataclass(frozen=True)
class Report:
    """A report that `build` has written."""

    text: str
    """The tables for a terminal, then the path of report.html."""
    folder: Path
    """The folder with the files."""
    files: tuple[Path, ...]
    """Every file that was written, sorted."""


def build(
    store_path: Path,
    sweep_ids: str | Sequence[str] | None = None,
    out: Path | None = None,
    pictures: Sequence[str] | None = None,
    against: str = BASELINE,
    choice: Choice = Choice(),  # noqa: B008 - it is frozen
    externals: Sequence[External] = (),
    design: Design | None = None,
) -> Report:
    """Write the tables, scores and figures of a sweep, or of several that are joined.

    The arguments are those of `xrgs-report`, whose help explains them; without `sweep_ids` the
    latest sweep is taken. `pictures` are names for `xrgs.report.pictures.draw`; None draws all.
    `design` has outcomes, headline labels and margins of the tests; None takes the defaults.

    Raises:
        StoreError: The store has no such sweep.
        ReportError: The sweeps contradict each other, lack a chosen scene or label, or have cells
            that can't be compared; there is no picture of such a name; or `out` can't be written.
    """
    store = ReportStore(store_path)
    named = (sweep_ids,) if isinstance(sweep_ids, str) else sweep_ids
    ids = tuple(dict.fromkeys(named or (store.latest_sweep(),)))
    commands, rows = store.sweep_records(ids)
    labels = [row.label for _, row in rows]
    base = labels[0] if against == BASELINE and BASELINE not in labels else against
    sweep = read_cells(store, commands, choice.rows(rows, base))
    sweep = with_variants(sweep, store)
    sweep = with_external(sweep, store, externals)
    store.external = sweep.renders
    sweep = replace(sweep, views=with_texture(store, sweep.cells, sweep.views))
    comparison = compare(sweep.cells, METRICS, base, design)
    notes = decided_by_one_view(comparison, sweep.views)
    page = _Page(sweep, Tables(comparison, contexts(sweep), notes))
    against_base = "" if against == BASELINE else f".against-{for_file_name(against)}"
    others = "".join(f".with-{for_file_name(one.label)}" for one in externals)
    name = f"{report_name(ids)}{choice.suffix}{against_base}{others}"
    folder = out if out else store.reports / name
    try:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
        files = page.write(folder, store, pictures)
    except OSError as error:
        raise ReportError(
            f"the report can't be written to {folder}: {error.filename}: {error.strerror};"
            " name another folder with --out"
        ) from error
    text = f"{page.text()}\n{for_line(f'Page: {folder / PAGE}')}"
    return Report(text=text, folder=folder, files=tuple(sorted(files)))


class _Page:
    """The tables of a sweep, and what is written of them."""

    def __init__(self, sweep: Sweep, tables: Tables) -> None:
        self._sweep = sweep
        self._tables = tables
        comparison = tables.comparison
        self._warnings = _warnings(sweep, comparison)
        self._conditions = list(dict.fromkeys(comparison.cells["condition"]))
        paper = paper_tables(comparison, tables.contexts)
        #: The tables of all ablations: changes, the paper's numbers, shares of the gap.
        self._overviews = [*tables.overviews(), *paper, *tables.gaps()]
        #: Each ablation's table of means and, with several scenes, its table of scenes.
        self._ablations: list[TextTable] = []
        for group in comparison.groups:
            self._ablations.append(tables.mean(*group))
            if len(comparison.scenes) > 1:
                self._ablations.append(tables.per_scene(*group))

    def write(self, folder: Path, store: ReportStore, pictures: Sequence[str] | None) -> list[Path]:
        """Write all files of a report; return their paths."""
        sweep, tables, comparison = self._sweep, self._tables, self._tables.comparison
        base, cells = comparison.base, comparison.cells
        cells = cells[~cells["cell_id"].isin(sweep.renders)]  # nothing is known of other programs
        runs = {
            "training": work.totals(cells, sweep.done),
            "curves": curves.joined(cells, sweep.done),
            "time_to_quality": curves.times(cells, sweep.done),
            "skipped": work.skipped(cells, sweep.done),
        }
        drawn = draw(store, comparison, sweep.views, runs["curves"], folder / "figures", pictures)
        changes, long = self._changes(), tables.long()
        everything = [*changes, *texture_tables(comparison, sweep.views, tables.contexts)]
        by_condition = cells.groupby("condition", sort=False)["label"].unique()
        labels = {str(name): list(of) for name, of in by_condition.items()}
        makers = (
            partial(curves.table, runs["time_to_quality"], base=base),
            partial(work.skipped_table, runs["skipped"], base=base),
            partial(work.totals_table, runs["training"]),
        )
        everything += [make(of, name) for make in makers for name, of in labels.items()]
        made = sweep.provenance
        rows = tuple((key, "; ".join(made.get(key, ["n/a"]))) for key in _PROVENANCE_KEYS)
        everything.append(TextTable("Made with", ("", "values"), rows, "ll"))
        everything = [table for table in everything if table.rows]
        files = [picture.file for picture in drawn if picture.file]
        texts = {
            "table.tex": latex_file([table for table in changes if table.rows]),
            "table.md": self._markdown(everything, drawn, folder),
        }
        data = _data(sweep, comparison) | runs | {"table": long}
        texts |= {f"{name}.csv": _csv(table) for name, table in data.items()}
        for name, text in texts.items():
            write_text(folder / name, text)
        provenance = {for_line(key): [*map(for_line, of)] for key, of in made.items()}
        write_json(folder / "provenance.json", provenance)
        write_document(
            folder / PAGE,
            store,
            sweep,
            tables,
            long,
            everything,
            runs["curves"],
            self._warnings,
            pictures=pictures is None or bool(pictures),
        )
        return [*files, *(folder / name for name in (*texts, "provenance.json", PAGE))]

    def _changes(self) -> list[TextTable]:
        """Return all tables of changes and values: missing cells first, then overviews."""
        tables, shown = self._tables, [*self._overviews, *self._ablations]
        result = [*self._overviews, legend(tables.comparison, shown), *self._ablations]
        result += [tables.scores(name) for name in self._conditions]
        result += [tables.values(name) for name in self._conditions]
        missing = tables.missing()
        return [missing, *result] if missing else result

    def _markdown(
        self, tables: Sequence[TextTable], pictures: Sequence[Picture], folder: Path
    ) -> str:
        lines = [f"# Change from {for_markdown(self._tables.comparison.base)}\n"]
        for sweep_id, command in self._sweep.commands.items():
            words = (for_markdown(shlex.quote(word)) for word in ("xrgs-sweep", *command))
            lines.append(f"Sweep {for_markdown(sweep_id)}: {' '.join(words)}\n")
        lines += [f"**{for_markdown(line)}**\n" for line in self._warnings]
        lines += map(to_markdown, tables)
        if by_scene := photographs(self._sweep):
            notes = (f"{scene}: {note}" for scene, of in by_scene for note in of)
            lines += ["## Photographs\n", *(f"- {for_markdown(note)}\n" for note in notes)]
        for picture in pictures:
            title, file = for_markdown(picture.title), picture.file
            if file is None:
                lines.append(f"No picture of {title}: {for_markdown(picture.why)}\n")
            else:
                lines.append(f"![{title}]({file.relative_to(folder)})\n\n{title}\n")
        return "\n".join(lines)

    def text(self) -> str:
        """Return the text for a terminal, which has only some of the tables."""
        tables, printed = self._tables, list(self._overviews)
        if len(tables.comparison.groups) <= _MAX_PRINTED_ABLATIONS:
            printed += self._ablations
        if any(table.rows for table in printed):
            printed.append(legend(tables.comparison, printed))
        else:  # nothing can be compared, or not yet
            printed += [tables.values(name) for name in self._conditions]
        if missing := tables.missing():
            more = len(missing.rows) - _MAX_PRINTED_MISSING
            notes = (*missing.notes, *([f"and {more} more, in table.md"] if more > 0 else []))
            first = replace(missing, rows=missing.rows[:_MAX_PRINTED_MISSING], notes=notes)
            printed.insert(0, first)
        return "\n".join(
            [*(to_text(table) for table in printed if table.rows), *map(for_line, self._warnings)]
        )


def _data(sweep: Sweep, comparison: Comparison) -> dict[str, pd.DataFrame]:
    """Return the tables of cells and views, for other programs."""
    cells = comparison.cells
    metrics = [metric.name for metric in comparison.metrics]
    counts = ["steps", "long_side", "factor"]
    order = [*RECORD_KEYS, "state", "reason", *counts, "protocol", "stale", "validation", "machine"]
    whole = cells[counts].astype("Int64").astype(object)  # without a decimal point, or missing
    names = cells.drop_duplicates("cell_id")[CELL_KEYS]
    return {
        "cells": cells[[*order, *metrics]].assign(**whole),
        "views": names.merge(sweep.views, on="cell_id"),
    }


def _csv(table: pd.DataFrame) -> str:
    safe = table.rename(columns=for_csv).map(for_csv)
    return str(safe.to_csv(index=False, lineterminator="\n"))


def _warnings(sweep: Sweep, comparison: Comparison) -> list[str]:
    warnings = []
    states = sweep.cells["state"]
    if pending := int((states == "pending").sum()):
        warnings.append(
            f"{pending} of {len(states)} cells are not done yet: the same xrgs-sweep command trains"
            " them. The tables are of the cells that are done."
        )
    if (states == "not placed").any():
        heading, *steps = TO_TRY
        warnings.append(f"{heading} {'; '.join(steps)}.")
    programs = sweep.cells.loc[sweep.cells["cell_id"].isin(sweep.renders), "label"]
    if others := ", ".join(dict.fromkeys(programs)):
        warnings.append(
            f"Renders of another program: {others}. Their PNGs are scored, and compared with the"
            " cells of the lowest seed; time, Gaussians and memory are not known."
        )
    warnings += _stale_warning(sweep)
    if why := why_no_table(sweep.cells["label"], sweep.cells["scene"]):
        warnings.append(why)
    shares = sorted({share for share in sweep.cells["validation"].dropna() if share > 0})
    if shares:
        listed = ", ".join(f"train.validation={share:g}" for share in shares)
        warnings.append(
            f"Scores are of held-out training views where the tables say {listed}: to choose by,"
            " not to compare with scores of test views."
        )
    machines = sorted(set(sweep.cells["machine"]) - {""})
    if len(machines) > 1:
        same = len({*map(without_threads, machines)}) == 1
        how = "with different numbers of threads" if same else "on different machines"
        warnings.append(
            f"The cells were trained {how} ({'; '.join(machines)}): times are compared only between"
            f" cells of {'one number of threads' if same else 'one machine'}."
        )
    arithmetics = sweep.provenance.get("arithmetic", ())
    if len(arithmetics) > 1:
        warnings.append(
            f"The cells were trained with different arithmetic ({', '.join(arithmetics)}): that"
            " makes cells differ as much as another seed does."
        )
    warnings += fewer_replicates(comparison)
    return [*warnings, *other_settings(sweep, comparison), *other_code(sweep)]


def _stale_warning(sweep: Sweep) -> list[str]:
    """Warn of scores that are missing, or that other code than the installed computed."""
    stale = sweep.cells.loc[sweep.cells["stale"] != "", ["cell_id", "stale"]].drop_duplicates()
    if stale.empty:
        return []
    names = {name for text in stale["stale"] for name in text.split()}
    always = {m.name for m in METRICS if PROTOCOL in names and not m.optional}
    scores = [m.label for m in METRICS if m.score and m.name in names | always]
    return [
        f"Scores of {counted(len(stale), 'cell')} are missing, or other code than the installed has"
        f" computed them ({', '.join(scores)}): xrgs-store rescore computes them. A score is"
        " compared between cells that the same code has scored."
    ]
