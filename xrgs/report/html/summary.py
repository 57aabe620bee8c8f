"""The answer that the page begins with, and the context that a table needs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xrgs.report.html.content import shown
from xrgs.report.render import titled
from xrgs.report.writing import arrow, by_key, reading, signed
from xrgs.safeio.sanitize import counted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import pandas as pd

    from xrgs.capture.views import Variant
    from xrgs.evaluation.metrics import Metric
    from xrgs.report.collect import Sweep
    from xrgs.report.compare import Comparison
    from xrgs.report.context import Context
    from xrgs.report.joined import JoinedStore
    from xrgs.report.writing import Change

#: Entries of the provenance that the context has.
_MADE_WITH = {
    "arithmetic": "Arithmetic",
    "xrgs": "xrgs",
    "git": "Commit",
}


@dataclass(frozen=True)
class Answer:
    """What one ablation changed."""

    label: str
    condition: str
    pairs: str
    """On how many scenes and pairs."""
    better: tuple[str, ...]
    """The metrics whose interval shows an improvement, with their change."""
    worse: tuple[str, ...]
    undecided: tuple[tuple[str, tuple[str, ...]], ...]
    """Why nothing can be said of the other metrics, and which these are, with their change."""


def answers(comparison: Comparison) -> list[Answer]:
    """Return what each ablation changed, in the order of the tables.

    Args:
        comparison: The comparison.
    """
    means = by_key(comparison.means)
    found = []
    for label, condition in comparison.groups:
        rows = [
            (metric, means[label, condition, metric.name])
            for metric in comparison.metrics
            if (label, condition, metric.name) in means
        ]
        readings: dict[str, list[str]] = {}
        for metric, row in rows:
            readings.setdefault(shown(reading(row, metric)), []).append(_change(metric, row))
        better, worse = (tuple(readings.pop(verdict, ())) for verdict in ("better", "worse"))
        scenes = max((row.scenes for _, row in rows), default=0)
        pairs = max((row.pairs for _, row in rows), default=0)
        found.append(
            Answer(
                label=shown(label),
                condition=shown(condition),
                pairs=f"{counted(scenes, 'scene')}, {counted(pairs, 'pair')} of cells",
                better=better,
                worse=worse,
                undecided=tuple((why, tuple(texts)) for why, texts in readings.items()),
            )
        )
    return found


def _change(metric: Metric, row: Change) -> str:
    if math.isnan(row.change):
        return metric.label
    absolute = f" ({signed(row.difference)} dB)" if metric.unit == "dB" else ""
    return f"{metric.label} {signed(row.change)} % {arrow(row.change, metric)}{absolute}"


def context(
    store: JoinedStore,
    sweep: Sweep,
    comparison: Comparison,
    contexts: Mapping[str, Context],
    variants: Mapping[str, Variant],
) -> list[tuple[str, str]]:
    """Return what the numbers of the page were made with: names and values.

    Args:
        store: The store with the cells.
        sweep: The sweep.
        comparison: The comparison of its cells.
        contexts: How the cells of each condition were trained and scored.
        variants: The variants of the cells that can be read, by their ids.
    """
    cells = comparison.cells
    own = cells[(cells["state"] == "done") & ~cells["cell_id"].isin(store.external)]
    done = own.drop_duplicates("cell_id")
    replicates = done.drop_duplicates(["variant_seed", "seed"])
    rows = [
        ("Compared with", shown(comparison.base)),
        ("Scenes", ", ".join(map(shown, comparison.scenes))),
        ("Replicates (variant.seed/seed)", _listed(_replicates(replicates))),
        ("Cells", f"{len(done)} of {cells['cell_id'].nunique()} are done"),
    ]
    for condition, of in contexts.items():
        rows.append((shown(titled("Training and scores", condition)), of.of_scores))
        rows.append((shown(titled("Times", condition)), of.of_times))
    rows += [(shown(scene), text) for scene, text in _views(done, variants)]
    rows += [
        (name, _listed(sweep.provenance.get(key, ["n/a"]))) for key, name in _MADE_WITH.items()
    ]
    return [(name, text) for name, text in rows if text]


def _replicates(rows: pd.DataFrame) -> list[str]:
    return [f"{draw}/{seed}" for draw, seed in zip(rows["variant_seed"], rows["seed"], strict=True)]


def _listed(values: Iterable[Any]) -> str:
    """List distinct values in their order."""
    return shown(", ".join(dict.fromkeys(str(value) for value in values)))


def _views(done: pd.DataFrame, variants: Mapping[str, Variant]) -> list[tuple[str, str]]:
    """Return the numbers and sizes of the views of each scene's first variant."""
    rows = []
    for scene, variant_id in done.drop_duplicates("scene")[["scene", "variant_id"]].to_numpy():
        variant = variants.get(variant_id)
        if variant is None:
            continue
        by_kind = {
            "HR": [v for v in variant.views if v.split == "train" and v.tag == "HR"],
            "LR": [v for v in variant.views if v.split == "train" and v.tag == "LR"],
            "test": [v for v in variant.views if v.split == "test"],
        }
        sizes = {
            kind: _listed(f"{view.width} × {view.height}" for view in views)
            for kind, views in by_kind.items()
        }
        text = "; ".join(
            f"{len(views)} {kind} ({sizes[kind]} px)" for kind, views in by_kind.items() if views
        )
        rows.append((f"Views of {scene}", text))
    return rows
