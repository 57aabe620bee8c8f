"""The content of the page: verdicts, context and curves, as plain values for JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import METRICS, VIEW_METRICS
from xrgs.mixture.views import Variant
from xrgs.report.collect import CURVE_COLUMNS, ReportStore, Sweep
from xrgs.report.compare import RUN, Comparison
from xrgs.report.context import Context
from xrgs.report.markup import titled
from xrgs.report.writing import by_key, number, verdict, with_unit
from xrgs.safeio.sanitize import MAX_CELL, counted, for_line
from xrgs.store.cell_folder import HISTORY, number_columns


@dataclass
class Content:
    """The parts of the page that its script shows, as lists of plain JSON values."""

    images: list[str] = field(default_factory=list)
    """Data URLs; the other parts name an image by its index in this list."""
    views: list[dict[str, Any]] = field(default_factory=list)
    """Test views with their scores, and images unless they were left out."""
    training: list[dict[str, Any]] = field(default_factory=list)
    """Training views with their renders."""
    curves: list[dict[str, Any]] = field(default_factory=list)
    """Quality during training of each cell."""
    history: list[dict[str, Any]] = field(default_factory=list)
    """Counts of each cell over its steps: Gaussians, and those grown and pruned by each rule."""
    trade_offs: list[dict[str, Any]] = field(default_factory=list)
    """Gaussians and scores of each label and scene."""
    models: list[dict[str, Any]] = field(default_factory=list)
    """Gaussians to look at in 3D."""
    cameras: list[dict[str, Any]] = field(default_factory=list)
    """The cameras of the models."""
    notes: list[str] = field(default_factory=list)
    """Sentences on what was left out, and why."""
    single: bool = False
    """Whether all cells have one label, so that there is nothing to compare."""
    mixed: bool = True
    """Whether photographs differ in resolution, so that the page names HR and LR."""


def shown(text: object) -> str:
    """Return a text from a store as one printable line of bounded length."""
    return for_line(str(text), MAX_CELL)


def why(error: Exception, store: ReportStore) -> str:
    """Return the message of an error, without the store's path."""
    return shown(store.without_paths(str(error)))


def finite(value: float) -> float | None:
    """Return a number for JSON, rounded to 7 digits; None for NaN and infinity."""
    number = float(value)
    return float(f"{number:.7g}") if math.isfinite(number) else None


def run_names(row: Mapping[str, Any] | pd.Series) -> dict[str, str]:
    """Return the texts of scene, condition and replicate of a row with the keys `RUN`."""
    return {
        "scene": shown(row["scene"]),
        "condition": shown(row["condition"]),
        "replicate": f"{row['variant_seed']}/{row['seed']}",
    }


#: The most runs on the page. Nobody looks through more, and the CSV files have all.
_MAX_RUNS = 100


def runs(content: Content, comparison: Comparison) -> list[pd.DataFrame]:
    """Return the finished cells of each scene, condition and replicate on the page, the base first.

    They are rows of `Comparison.cells`, one for each label. The first replicates of all scenes and
    conditions come before the second ones. Of more than `_MAX_RUNS` runs the others are left out,
    and a note says so.
    """
    cells = comparison.cells
    done = cells[cells["state"] == "done"].drop_duplicates([*RUN, "label"])
    done = done.sort_values("label", key=lambda label: label != comparison.base, kind="stable")
    names = done[RUN].drop_duplicates().sort_values(RUN)
    ranks = names.groupby(["scene", "condition"]).cumcount()
    first = names.loc[ranks.sort_values(kind="stable").index[:_MAX_RUNS]]
    if len(first) < len(names):
        content.notes.append(
            f"Views and curves are of {len(first)} of {len(names)} runs (a scene, condition and"
            " replicate); views.csv and curves.csv have all."
        )
    groups = done.groupby(RUN, sort=False)
    return [groups.get_group(name) for name in first.itertuples(index=False, name=None)]


#: Columns of a history that the page shows, in its order.
RULES = (
    "gaussians",
    "duplicated",
    "split",
    "added",
    "relocated",
    "pruned_opacity",
    "pruned_scale",
    "pruned_by_components",
    "pruned_non_finite",
)
#: The most rows of a history that are drawn, evenly spaced; a plot has hardly more pixels.
_MAX_ROWS = 240


def add_curves(content: Content, of_runs: Sequence[pd.DataFrame], quality: pd.DataFrame) -> None:
    """Add the quality during training of each of these cells that was evaluated during training."""
    ids = {cell_id for rows in of_runs for cell_id in rows["cell_id"]}
    quality = quality[quality["cell_id"].isin(ids)]
    for _, rows in quality.groupby([*RUN, "label"], sort=False):
        first = rows.iloc[0]
        columns = {name: [finite(value) for value in rows[name]] for name in CURVE_COLUMNS}
        content.curves.append(run_names(first) | {"label": shown(first["label"])} | columns)


def add_history(content: Content, store: ReportStore, of_runs: Sequence[pd.DataFrame]) -> None:
    """Add the counts over steps (`RULES`) of each of these cells."""
    for rows in of_runs:
        for _, row in rows[~rows["cell_id"].isin(store.external)].iterrows():
            try:
                history = number_columns(store.cell(row["cell_id"]).path / HISTORY)
            except StoreError as error:
                label = f"{shown(row['scene'])}, {shown(row['label'])}"
                content.notes.append(f"{label}: no history, {why(error, store)}")
                continue
            count = len(history["step"])
            step = max(1, -(-count // _MAX_ROWS))
            kept = [*range(0, count, step)] + [count - 1] * ((count - 1) % step > 0)
            names = [name for name in ("step", *RULES) if name in history]
            columns = {name: [finite(history[name][at]) for at in kept] for name in names}
            content.history.append(run_names(row) | {"label": shown(row["label"])} | columns)


def add_trade_offs(content: Content, comparison: Comparison) -> None:
    """Add Gaussians and scores of each label and scene, as means over the replicates."""
    cells = comparison.cells
    done = cells[cells["state"] == "done"]
    names = ["gaussians", *VIEW_METRICS]
    means: Any = done.groupby(["condition", "scene", "label"], sort=False)[names].mean()
    for (condition, scene, label), row in means.iterrows():
        numbers: dict[str, Any] = {name: finite(row[name]) for name in names}
        texts = {"condition": shown(condition), "scene": shown(scene), "label": shown(label)}
        content.trade_offs.append(texts | numbers)


#: The metrics that the page of one label shows first.
_SUMMARY = ("psnr", "ssim", "lpips", "gaussians", "training_time_s")


def summary(comparison: Comparison) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return (scene, [(metric, value)]) for the metrics of `_SUMMARY`: means over done cells.

    Several conditions have an entry each, with the condition beside the scene's name.
    """
    done = comparison.cells[comparison.cells["state"] == "done"]
    named = {metric.name: metric for metric in METRICS}
    metrics = [named[name] for name in _SUMMARY]
    several = len(set(done["condition"])) > 1
    groups: Any = done.groupby(["scene", "condition"])
    return [
        (
            shown(titled(scene, condition) if several else scene),
            [(m.label, number(v, m.unit)) for m in metrics if (v := rows[m.name].mean()) == v],
        )
        for (scene, condition), rows in groups
    ]


#: Entries of the provenance in the page's context -> their names there.
_MADE_WITH = {
    "arithmetic": "Arithmetic",
    "xrgs": "xrgs",
    "git": "Commit",
}


def answers(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the verdicts on each ablation, in the order of the tables.

    Each has its label, condition and number of pairs, the outcomes that are shown to be `better` or
    `worse` with their changes, and in `undecided` the metrics of each other verdict.
    """
    means = by_key(comparison.means)
    result: list[dict[str, Any]] = []
    for label, condition in comparison.groups:
        rows = [
            (metric, means[label, condition, metric.name])
            for metric in comparison.metrics
            if (label, condition, metric.name) in means
        ]
        verdicts: dict[str, list[str]] = {}
        for metric, row in rows:
            change = "" if math.isnan(row.change) else f" {with_unit(row.change, metric)}"
            text = f"{metric.label}{change}"
            verdicts.setdefault(shown(verdict(row, metric)), []).append(text)
        scenes = max((row.scenes for _, row in rows), default=0)
        pairs = max((row.pairs for _, row in rows), default=0)
        result.append(
            {
                "label": shown(label),
                "condition": shown(condition),
                "pairs": f"{counted(scenes, 'scene')}, {counted(pairs, 'pair')} of cells",
                "better": verdicts.pop("better", []),
                "worse": verdicts.pop("worse", []),
                "undecided": verdicts.items(),
            }
        )
    return result


def page_context(
    sweep: Sweep,
    comparison: Comparison,
    contexts: Mapping[str, Context],
    variants: Mapping[str, Variant],
) -> list[tuple[str, str]]:
    """Return the rows (name, text) of the page's section on context."""
    cells = comparison.cells
    done = cells[cells["cell_id"].isin(sweep.done)].drop_duplicates("cell_id")
    replicates, planned = done[["variant_seed", "seed"]].to_numpy(), cells["cell_id"].nunique()
    of_many = [
        ("Compared with", shown(comparison.base) if comparison.groups else ""),
        ("Scenes", ", ".join(map(shown, comparison.scenes))),
        ("Replicates (variant.seed/seed)", _listed(f"{draw}/{seed}" for draw, seed in replicates)),
        ("Cells", f"{len(done)} of {planned} are done"),
    ]
    rows = of_many if planned > 1 else []
    for condition, context in contexts.items():
        rows.append((shown(titled("Training and scores", condition)), context.of_scores))
        rows.append((shown(titled("Times", condition)), context.of_times))
    rows += [(shown(scene), text) for scene, text in _views(sweep, done, variants)]
    provenance = sweep.provenance
    rows += [(name, _listed(provenance.get(key, ["n/a"]))) for key, name in _MADE_WITH.items()]
    return [(name, text) for name, text in rows if text]


def _listed(values: Iterable[Any]) -> str:
    """Join distinct values in their order by commas."""
    return shown(", ".join(dict.fromkeys(str(value) for value in values)))


def _views(
    sweep: Sweep, done: pd.DataFrame, variants: Mapping[str, Variant]
) -> list[tuple[str, str]]:
    """Return the numbers and sizes of the views of each scene's first variant."""
    rows = []
    for scene, variant_id in done.drop_duplicates("scene")[["scene", "variant_id"]].to_numpy():
        variant = variants.get(variant_id)
        if variant is None:
            continue
        train = [v for v in variant.views if v.split == "train"]
        by_kind = {"training": train}
        if not sweep.variants[variant_id].alike:
            by_kind = {tag: [v for v in train if v.tag == tag] for tag in ("HR", "LR")}
        by_kind["test"] = [v for v in variant.views if v.split == "test"]
        sizes = {
            kind: _listed(f"{view.width} × {view.height}" for view in views)
            for kind, views in by_kind.items()
        }
        text = "; ".join(
            f"{len(views)} {kind} ({sizes[kind]} px)" for kind, views in by_kind.items() if views
        )
        rows.append((f"Views of {scene}", text))
    return rows
