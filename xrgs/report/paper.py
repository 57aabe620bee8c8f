"""The paper's claims beside a sweep's own results: Tables 1 and 2, section 7.2, and the figures."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import Metric
from xrgs.report.averages import averaged
from xrgs.report.collect import ReportStore
from xrgs.report.compare import Comparison, is_ratio
from xrgs.report.context import Context
from xrgs.report.inference import MIN_VALUES, log_ratio
from xrgs.report.markup import filled, titled
from xrgs.report.writing import (
    Change,
    by_key,
    interval,
    lacking,
    named,
    pointed,
    same_sign,
    signed,
)
from xrgs.runtime.progress import ProgressBar
from xrgs.runtime.text import TextTable, listed
from xrgs.safeio.sanitize import counted
from xrgs.store.store import BASELINE
from xrgs.store.trimming import home_of, textures

#: Labels of the full XR-GS; each reads section 5.4 of the paper in another way.
_READINGS = ("xrgs", "xrgs_per_class", "xrgs_own_threshold")
#: The scenes of LLFF in the means of Table 1.
_LLFF = frozenset({"fern", "flower", "fortress", "horns", "orchids", "room", "trex"})


class _Column(NamedTuple):
    """A column of one of the paper's tables."""

    title: str
    scenes: frozenset[str]
    """The scenes of Table 1; for Table 2 the paper's scene and our substitute for it."""
    changes: Mapping[str, float]
    """Name of a metric -> its change, %."""


#: The metrics of the paper's tables, in the order of the numbers below.
_METRICS = ("training_time_s", "gaussians", "memory_bytes", "lpips", "ssim", "psnr")


def _column(title: str, scenes: frozenset[str], *changes: float) -> _Column:
    return _Column(title, scenes, dict(zip(_METRICS, changes, strict=True)))


_TABLE_1 = _column("the paper's Table 1", _LLFF, -44.57, -69.68, -46.50, 23.15, 0.45, -0.80)
_TABLE_2 = (
    _column(
        "the paper's Table 2, Dining Room",
        frozenset({"dining_room", "monstree"}),
        *(-24.87, -70.99, -33.08, -8.83, 3.60, 3.92),
    ),
    _column(
        "the paper's Table 2, Keychain",
        frozenset({"keychain", "ollie"}),
        *(-16.32, -66.05, -2.59, 33.23, -1.56, -15.81),
    ),
)


#: Metrics of the paper that measure another quantity here -> the reason.
_NOT_COMPARABLE = {
    "memory_bytes": "the paper probably has gsplat's number, which is what torch allocates on the"
    " GPU, without the photographs; here every tensor that training holds is counted"
}


def why_no_table(labels: Iterable[str], scenes: Iterable[str]) -> str:
    """Say why a sweep of full XR-GS has no table beside Table 1; empty if it has one.

    It is empty too if the sweep has no full XR-GS or no scene of Table 1.
    """
    names = sorted({*scenes})
    others, of_llff = [s for s in names if s not in _LLFF], [s for s in names if s in _LLFF]
    if not (others and of_llff) or {*labels}.isdisjoint(_READINGS):
        return ""
    return (
        f"No table is beside the paper's Table 1, since the means have scenes outside it:"
        f" {listed(others)}. `xrgs-report --scenes {' '.join(of_llff)}` makes one."
    )


def paper_tables(comparison: Comparison, contexts: Mapping[str, Context]) -> list[TextTable]:
    """Return the paper's tables beside the changes of full XR-GS from the baseline.

    There is a table for each condition and each column of the paper whose scenes the comparison
    has; none if no label is full XR-GS, or the base is not the baseline.
    """
    labels = {label for label, _ in comparison.groups}
    if comparison.base != BASELINE or labels.isdisjoint(_READINGS):
        return []
    # log(value / base) is the effect of PSNR too: the paper has percent.
    pairs, names = comparison.pairs, [metric.name for metric in comparison.metrics]
    in_db = [metric.name for metric in comparison.metrics if not is_ratio(metric)]
    rows = pairs["metric"].isin(in_db) & pairs["effect"].notna()
    effect, why = log_ratio(*(pairs[name].to_numpy(np.float64) for name in ("base", "value")))
    pairs = pairs.assign(
        effect=np.where(rows, effect, pairs["effect"]), why=np.where(rows, why, pairs["why"])
    )
    per_scene, means = map(by_key, averaged(pairs, names))
    tables = []
    for condition in dict.fromkeys(condition for _, condition in comparison.groups):
        context = contexts.get(condition, Context()).of_all
        if _LLFF.issuperset(comparison.scenes):
            tables.append(_beside(comparison, condition, _TABLE_1, means, "", context))
        for column in _TABLE_2:
            for scene in sorted(column.scenes.intersection(comparison.scenes)):
                here: dict[tuple[str, ...], Change] = {
                    (label, of, metric): row
                    for (label, of, name, metric), row in per_scene.items()
                    if name == scene
                }
                tables.append(_beside(comparison, condition, column, here, scene, context))
    return [table for table in tables if table.rows]


def _beside(
    comparison: Comparison,
    condition: str,
    column: _Column,
    changes: Mapping[tuple[str, ...], Change],
    scene: str,
    context: str,
) -> TextTable:
    """Compare a column of the paper with a scene's changes, or their mean if `scene` is empty."""
    scenes = 1 if scene else len(comparison.scenes)
    rows = [
        _row(label, metric, column.changes[metric.name], row, scenes)
        for label in _READINGS
        for metric in comparison.metrics
        if metric.name in column.changes
        and (row := changes.get((label, condition, metric.name))) is not None
    ]
    extent = scene or f"mean over {counted(scenes, 'scene')}"
    metrics = [metric for metric in comparison.metrics if metric.name in column.changes]
    table = TextTable(
        title=titled(f"Beside {column.title}: {extent}", condition),
        columns=(
            *("XR-GS", "Metric", "paper, %", "here, %", "95 % interval"),
            *("here / paper", "same sign (p)", "the paper's sign is"),
        ),
        rows=tuple(rows),
        align="llrrrrrl",
        notes=(
            "confirmed: the 95 % interval is on the paper's side of 0; refuted: it is on the other"
            " side; open: it holds 0, is of fewer than three values, or there is none",
            *(
                f"{metric.label} is not comparable: {_NOT_COMPARABLE[metric.name]}"
                for metric in metrics
                if metric.name in _NOT_COMPARABLE
            ),
        ),
        context=context,
    )
    return filled(table)


def _row(label: str, metric: Metric, paper: float, row: Change, scenes: int) -> tuple[str, ...]:
    comparable = metric.name not in _NOT_COMPARABLE
    return (
        label,
        metric.label,
        pointed(paper, metric),
        f"{pointed(row.change, metric)}{lacking(row, scenes)}",
        interval(row.low, row.high),
        f"{row.change / paper:.2f}" if comparable and not math.isnan(row.change) else "",
        same_sign(row),
        _verdict(row, paper) if comparable else "not comparable",
    )


def _verdict(row: Change, paper: float) -> str:
    """Compare the sign of a change with the paper's: `confirmed`, `refuted` or `open`."""
    if math.isnan(row.low) or row.n < MIN_VALUES or row.low <= 0 <= row.high:
        return "open"
    return "confirmed" if (row.change > 0) == (paper > 0) else "refuted"


_PHOTOGRAPH = ["variant_id", "split", "view"]


def with_texture(store: ReportStore, cells: pd.DataFrame, views: pd.DataFrame) -> pd.DataFrame:
    """Add the `texture` of each view's photograph to the scores of views, in intensity per px.

    It is NaN where the photograph can't be read, or was removed by a version that did not keep it.
    """
    scored = cells.drop_duplicates("cell_id").set_index("cell_id")[["variant_id", "validation"]]
    rows = views.join(scored, on="cell_id")
    rows["split"] = np.where(rows["validation"] > 0, "train", "test")
    photographs = rows[_PHOTOGRAPH].drop_duplicates().assign(texture=np.nan)
    names = photographs["split"] + "/" + photographs["view"]
    with ProgressBar("reading photographs", "photograph", len(photographs)) as bar:
        for variant_id, views_of in names.groupby(photographs["variant_id"], sort=False):
            with suppress(StoreError):
                known = textures(home_of(store.variants, str(variant_id)), [*views_of])
                photographs.loc[views_of.index, "texture"] = views_of.map(known)
            bar.update(len(views_of))
    found = rows.merge(photographs, on=_PHOTOGRAPH, how="left")["texture"]
    return views.assign(texture=found.to_numpy(np.float64))


def texture_tables(
    comparison: Comparison, views: pd.DataFrame, contexts: Mapping[str, Context]
) -> list[TextTable]:
    """Return tables of changes by texture, for conditions with at least three scenes.

    They have a row for each ablation and score: the change of each scene, the least textured scene
    first, and Spearman's rank correlation of texture and change.
    """
    keys = comparison.cells.drop_duplicates("cell_id")[["cell_id", "condition", "scene"]]
    rows = views[["cell_id", "view", "texture"]].merge(keys, on="cell_id")
    by_scene = rows.groupby(["condition", "scene"], sort=False)["texture"].mean().dropna()
    tables = []
    for condition in by_scene.index.unique("condition"):
        scenes = by_scene.loc[condition].sort_values(kind="stable")
        if len(scenes) >= MIN_VALUES:
            tables.append(_by_texture(comparison, contexts, condition, scenes))
    return tables


def _by_texture(
    comparison: Comparison, contexts: Mapping[str, Context], condition: str, scenes: pd.Series
) -> TextTable:
    """Return the table of a condition; `scenes` maps each scene to its texture, in rising order."""
    per_scene = by_key(comparison.per_scene)
    rows: list[tuple[str, ...]] = []
    metrics = [metric for metric in comparison.metrics if metric.score is not None]
    for label in [name for name, of in comparison.groups if of == condition]:
        for metric in metrics:
            found = [per_scene.get((label, condition, name, metric.name)) for name in scenes.index]
            values = [math.nan if row is None else row.change for row in found]
            changes = pd.Series(values, scenes.index)
            if changes.notna().any():
                texts = (pointed(change, metric) for change in changes)
                rows.append((label, named(metric), *texts, _rank_correlation(scenes, changes)))
    heads = tuple(f"{scene} ({value:.4f})" for scene, value in scenes.items())
    return TextTable(
        title=titled(f"Change from {comparison.base} by the texture of the scene", condition),
        columns=("Ablation", "Metric", *heads, "rank correlation"),
        rows=tuple(rows),
        align="ll" + "r" * (len(scenes) + 1),
        notes=(
            "texture, in parentheses: mean magnitude of the gradient of the scored photographs,"
            " intensity per px; the least textured scene first",
            "rank correlation: Spearman's, of texture and change over the scenes; it describes"
            " these scenes, and so few are no test",
        ),
        context=contexts.get(condition, Context()).of_scores,
    )


def _rank_correlation(textures: pd.Series, changes: pd.Series) -> str:
    """Write the rank correlation over scenes with a change; empty for too few or equal values."""
    valid = changes.notna()
    if valid.sum() < MIN_VALUES or changes[valid].nunique() < 2 or textures[valid].nunique() < 2:
        return ""
    return signed(textures[valid].corr(changes[valid], method="spearman"))


class _Figure(NamedTuple):
    """A figure of the paper: photograph, baseline and one ablation."""

    name: str
    shows: str
    ablation: str
    """Name of the shown ablation in `conf/ablation/`."""
    scenes: tuple[str, ...]
    """Names that the shown scene may have here; empty for any scene."""
    tag: str
    """`LR` or `HR` for a training view; empty for a test view."""


_FIGURES = (
    _Figure(
        "Figure 2",
        "an LR training view, loss weighting and gradient scaling (fern)",
        "loss_gradient",
        ("fern",),
        "LR",
    ),
    _Figure(
        "Figure 3",
        "an HR view, densification and pruning (orchids)",
        "densify",
        ("orchids",),
        "HR",
    ),
    _Figure("Figure 4", "resolution-aware rendering", "render_scale", (), "LR"),
    _Figure(
        "Figure 5",
        "an LR training view, consistency loss (dining room)",
        "consistency",
        ("dining", "dining_room"),
        "LR",
    ),
    _Figure("Figure 6", "a novel view, consistency loss", "consistency", (), ""),
    _Figure(
        "Figure 7",
        "the full method on a cluttered scene (dining room)",
        "xrgs",
        ("dining", "dining_room"),
        "",
    ),
    _Figure(
        "Figure 8",
        "the full method on a single object (keychain)",
        "xrgs",
        ("keychain",),
        "",
    ),
)


def counterparts(
    labels: Collection[str], views: Sequence[dict[str, Any]], training: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Find the view on a report's page that corresponds to each figure of the paper.

    The views are those of `xrgs.report.html.content.Content`. A view has its `section` of the page,
    `views` or `training`, its `place` there, and the `label` to select. `here` is its name, or why
    there is none.
    """
    found = []
    for figure in _FIGURES:
        section, entries = ("training", training) if figure.tag else ("views", views)
        fitting = [
            place
            for place, entry in enumerate(entries)
            if entry.get("tag", "") == figure.tag
            and any(arm["label"] == figure.ablation and "image" in arm for arm in entry["arms"])
        ]
        row: dict[str, Any] = {"name": figure.name, "shows": figure.shows, "section": ""}
        if figure.ablation not in labels:
            what = f"xrgs-sweep +ablation={figure.ablation} trains it"
            row["here"] = f"this sweep has no cell of it: {what}"
        elif not fitting:
            row["here"] = "the page has no picture of it, see below"
        else:
            same_scene = [place for place in fitting if entries[place]["scene"] in figure.scenes]
            place = (same_scene or fitting)[0]
            here = f"{entries[place]['scene']}, view {entries[place]['view']}, {figure.ablation}"
            row |= {"here": here, "section": section, "place": place, "label": figure.ablation}
        found.append(row)
    return found
