"""Writes the page: a template, its style and scripts, and the content, in one file.

The page needs no other file. Its Content-Security-Policy forbids the network, and allows one script
by its hash, so that a text from a store can never act as markup or script.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from xrgs.errors import XrgsError
from xrgs.evaluation.metrics import METRICS, VIEW_METRICS
from xrgs.mixture import variant
from xrgs.mixture.views import Variant
from xrgs.report.collect import ReportStore, Sweep
from xrgs.report.context import photographs, placement
from xrgs.report.html.content import (
    Content,
    add_curves,
    add_history,
    add_trade_offs,
    answers,
    finite,
    page_context,
    runs,
    shown,
    summary,
    why,
)
from xrgs.report.html.images import ERROR_RANGE, add_trained, add_views
from xrgs.report.markup import filled, filled_places, titled, to_latex, to_markdown
from xrgs.report.paper import counterparts
from xrgs.report.tables import Tables
from xrgs.report.writing import NO_INTERVAL, number, signed, with_unit
from xrgs.runtime.text import TextTable, listed
from xrgs.safeio.atomic import write_text
from xrgs.safeio.sanitize import for_csv, for_line

#: The largest page, bytes, and its parts for test views, training views and models.
MAX_BYTES = 10_000_000
_VIEW_BYTES, _TRAINING_BYTES, _MODEL_BYTES = 4_000_000, 1_500_000, 3_500_000
#: The scripts in the order of loading; the first defines what the others use.
_SCRIPTS = ("page.js", "tables.js", "views.js", "charts.js", "splats.js")


def write_document(
    file: Path,
    store: ReportStore,
    sweep: Sweep,
    tables: Tables,
    long: pd.DataFrame,
    texts: Sequence[TextTable],
    quality: pd.DataFrame,
    warnings: Sequence[str],
    *,
    pictures: bool,
) -> None:
    """Write the report of a sweep as one HTML file of at most `MAX_BYTES`.

    Raises:
        OSError: The file can't be written.
    """
    comparison, content = tables.comparison, Content()
    variants = _variants(store, comparison.cells, content)
    shown_runs = runs(content, comparison)
    add_views(content, store, shown_runs, sweep.views, _VIEW_BYTES * pictures)
    add_curves(content, shown_runs, quality)
    add_history(content, store, shown_runs)
    add_trade_offs(content, comparison)
    if pictures:
        add_trained(content, store, shown_runs, variants, _TRAINING_BYTES, _MODEL_BYTES)
    else:
        content.notes.append("Photographs, renders and models were left out: --pictures none.")
    single = not comparison.groups
    named = listed(comparison.scenes)
    head = {
        "id": shown(sweep.id),
        "single": single,
        "title": shown(named if single else f"Change from {comparison.base}"),
        "summary": summary(comparison),
        "commands": [shown(" ".join(("xrgs-sweep", *words))) for words in sweep.commands.values()],
        "base": shown(comparison.base),
        "answers": answers(comparison),
        "context": page_context(sweep, comparison, tables.contexts, variants),
        "photographs": _photographs(sweep, single=single),
        "warnings": [shown(text) for text in (*warnings, *tables.cautions)],
    }
    content.single = single
    content.mixed = not all(report.alike for report in sweep.variants.values())
    write_text(file, _fitting(head, content, tables, long, texts))


def _photographs(sweep: Sweep, *, single: bool) -> list[tuple[str, list[str]]]:
    """Return (scene, notes on its photographs); if `single`, the placement is the first note."""
    by_scene = dict(photographs(sweep))
    if single:
        done = sweep.cells.loc[sweep.cells["state"] == "done", "scene"].unique()
        by_scene = {scene: (placement(sweep, scene), *by_scene.get(scene, ())) for scene in done}
    return [(shown(scene), [*map(for_line, notes)]) for scene, notes in by_scene.items()]


def _variants(store: ReportStore, cells: pd.DataFrame, content: Content) -> dict[str, Variant]:
    """Load the variants of the finished cells; note those that can't be read."""
    variants = {}
    for name in cells.loc[cells["state"] == "done", "variant_id"].unique():
        try:
            variants[name] = variant.load(store.variant(name))
        except XrgsError as error:
            content.notes.append(f"Variant {shown(name)}: {why(error, store)}")
    return variants


def _fitting(
    head: dict[str, Any],
    content: Content,
    tables: Tables,
    long: pd.DataFrame,
    texts: Sequence[TextTable],
) -> str:
    """Return the page; parts are left out until it has at most `MAX_BYTES`."""
    changes = [*_changes(long, tables.comparison.scenes)]
    kept = filled_places([_texts(row) for row in changes])
    listed = filled(
        TextTable(
            f"Changes from {head['base']}",
            tuple(name.format(base=head["base"]) for name in _CHANGE_COLUMNS),
            tuple(map(_texts, changes)),
            "".join(_CHANGE_COLUMNS.values()),
        )
    )
    labels = [shown(label) for label, _ in tables.comparison.groups]
    style, script = _source("page.css"), "\n".join(map(_source, _SCRIPTS))
    copies = [_copies(table) for table in texts]
    for part in ("history", "models", "curves", ""):
        text = _template().render(
            head,
            policy=_policy(style, script),
            style=style,
            script=script,
            tables=[_printable(table) for table in texts],
            changes=[row | {"cells": [row["cells"][place] for place in kept]} for row in changes],
            change_columns=[*zip(listed.columns, listed.align, strict=True)],
            notes=list(dict.fromkeys(content.notes)),
            figures=counterparts(labels, content.views, content.training),
            error_range=ERROR_RANGE,
            data=vars(content)
            | {
                "base": head["base"],
                "copies": copies,
                "changes": _lines(listed),
                "scores": _scores(content),
            },
        )
        if len(text.encode()) <= MAX_BYTES or not part:
            break
        setattr(content, part, [])
        content.notes.append(f"The page has no {part}: with it, it would be too large.")
    return text


@cache
def _template() -> Template:
    environment = Environment(
        loader=PackageLoader("xrgs.report.html", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.get_template("page.html.jinja")


def _printable(table: TextTable) -> TextTable:
    """Make all texts of a table printable lines; those of its cells are cut to a length."""
    notes = (table.context, *table.notes) if table.context else table.notes
    return TextTable(
        shown(table.title),
        tuple(map(shown, table.heads)),
        tuple(tuple(map(shown, row)) for row in table.rows),
        table.align,
        tuple(map(for_line, notes)),
        prose=table.prose,
    )


def _source(name: str) -> str:
    """Read a style or script of the package; it must not have `</`, which ends its element."""
    return resources.files("xrgs.report.html").joinpath(name).read_text(encoding="utf-8")


def _policy(style: str, script: str) -> str:
    """Return the Content-Security-Policy: only this style and script, and images in data URLs."""

    def hashed(text: str) -> str:
        digest = hashlib.sha256(text.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"

    return (
        f"default-src 'none'; style-src {hashed(style)}; script-src {hashed(script)};"
        " img-src data:; base-uri 'none'; form-action 'none'"
    )


def _scores(content: Content) -> list[dict[str, Any]]:
    """Return the scores that any view has; LPIPS is missing without its weights."""
    of_views = [arm["scores"] for entry in content.views for arm in entry["arms"]]
    return [
        {
            "name": metric.name,
            "label": f"{metric.label}{metric.unit and f', {metric.unit}'}",
            "higher": metric.higher_is_better,
        }
        for metric in METRICS
        if metric.name in VIEW_METRICS and any(of[metric.name] is not None for of in of_views)
    ]


def _copies(table: TextTable) -> dict[str, str]:
    """Return a table in the formats of the copy buttons."""
    rows = [[for_csv(text) for text in row] for row in table.rows]
    columns = [for_csv(name) for name in table.columns]
    csv = pd.DataFrame(rows, columns=columns).to_csv(index=False, lineterminator="\n")
    return {"latex": to_latex(table), "markdown": to_markdown(table), "csv": str(csv)}


#: Format of a copy button -> the number of lines before a table's first row.
_HEAD_LINES = {"latex": 9, "markdown": 4, "csv": 1}


def _lines(table: TextTable) -> dict[str, dict[str, list[str]]]:
    """Return a table in the same formats, as lines, so that the page can copy some rows."""
    by_format = {}
    for form, text in _copies(table).items():
        lines, first = text.split("\n"), _HEAD_LINES[form]
        last = first + len(table.rows)
        by_format[form] = {"head": lines[:first], "rows": lines[first:last], "foot": lines[last:]}
    return by_format


#: Columns of the table of all changes -> their alignment; `{base}` is the base's label.
_CHANGE_COLUMNS = {
    "Ablation": "l", "Scene": "l", "Metric": "l", "Change": "r", "Verdict": "l", "{base}": "r",
    "Value": "r", "From": "r", "To": "r", "q": "r", "Same sign": "l",
}  # fmt: skip


def _texts(row: dict[str, Any]) -> tuple[str, ...]:
    return tuple(text for text, _, _ in row["cells"])


def _changes(long: pd.DataFrame, scenes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table of all changes, with text, number and class of each cell."""
    metrics = {metric.name: metric for metric in METRICS}
    only = scenes[0] if len(scenes) == 1 else ""
    for row in long.to_dict("records"):
        if row["level"] == "scene" and only:
            continue
        metric = metrics[row["metric"]]
        change = with_unit(row["change"], metric).strip()
        label, scene = shown(row["label"]), shown(row["scene"] or only)
        direction = {"↑": "better", "↓": "worse"}.get(change[-1:], "")
        verdict = "" if row["verdict"] == NO_INTERVAL else shown(row["verdict"])
        numbers = [
            (text, finite(row[name]), "")
            for name, text in (
                ("base", number(row["base"], metric.unit)),
                ("value", number(row["value"], metric.unit)),
                ("low", _signed(row["low"])),
                ("high", _signed(row["high"])),
                ("q", "" if pd.isna(row["q"]) else f"{row['q']:.3f}"),
            )
        ]
        yield {
            "label": label,
            "scene": scene,
            "metric": metric.label,
            "cells": [
                (titled(label, shown(row["condition"])), None, ""),
                ("" if only else scene or "mean", None, ""),
                (metric.label, None, ""),
                (change, finite(row["change"]), direction),
                (verdict, None, ""),
                *numbers,
                (f"{row['agree']} of {row['n_values']}" if row["n_values"] > 1 else "", None, ""),
            ],
        }


def _signed(value: float) -> str:
    return "" if pd.isna(value) else signed(value)
