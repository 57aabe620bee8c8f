"""Warns of cells in one table that differ in settings, in code, or in their replicates.

A sweep gives all cells of a label the same code, and the same settings but for those that the file
of a scene sets. Sweeps that are joined may differ in both without a contradiction: in scenes or
seeds that they don't share, or where one has no baseline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from xrgs.composing import dotted
from xrgs.report.collect import DoneCell, Sweep
from xrgs.report.compare import Comparison
from xrgs.runtime.text import listed
from xrgs.safeio.refactorings import canonical
from xrgs.safeio.sanitize import for_line
from xrgs.store.store import BASELINE

#: Settings that are meant to differ between cells of a label: the count of the arm that each is
#: matched to, and when scores are computed during training.
_OWN = frozenset({"components.count_matched.gaussians", "train.evaluate_every"})
_MAX_SENTENCE = 500
_MAX_KEYS = 8
#: Beginnings of overrides that every cell of a sweep has.
_GIVEN = ("preset=", "sweeps=", "train.", "splat.")
_PARTS = ("train", "splat", "components")
_REPLICATE = ["variant_seed", "seed"]


def other_settings(sweep: Sweep, comparison: Comparison) -> list[str]:
    """Return a warning for each label whose cells, or whose bases, have other settings.

    Cells of one label and condition should differ only in scene and replicate. A cell whose sweep
    has no baseline is compared with that of another sweep, which may have been given other values.
    """
    cells = comparison.cells[comparison.cells["cell_id"].isin(sweep.done)]
    settings = {cell_id: _settings(sweep.done[cell_id]) for cell_id in cells["cell_id"].unique()}
    several_commands = len({_given(command) for command in sweep.commands.values()}) > 1
    warnings = []
    groups: Any = cells.groupby(["label", "condition"], sort=False)
    for (label, condition), rows in groups:
        name = ", ".join(filter(None, (label, condition)))
        if keys := _differing([settings[cell_id] for cell_id in rows["cell_id"]]):
            values = "; ".join(_by_scene(key, sweep, rows) for key in keys[:_MAX_KEYS])
            warnings.append(f"Means of {name} are of cells with different settings: {values}.")
        foreign = rows[rows["baseline_id"].isna() & rows["base_id"].isin(settings)]
        if comparison.base != BASELINE or foreign.empty or not several_commands:
            continue
        cell_id, base_id = foreign.iloc[0][["cell_id", "base_id"]]
        differing = _differing([settings[cell_id], settings[base_id]])
        # A component is the ablation's. What else the ablation sets is not recorded.
        if keys := [key for key in differing if not key.startswith("components.")]:
            cell, base = sweep.done[cell_id], sweep.done[base_id]
            values = "; ".join(
                f"{k} {_value(cell, k)}, {_value(base, k)}" for k in keys[:_MAX_KEYS]
            )
            warnings.append(
                f"{name} is compared with the {BASELINE} of a sweep with another command, and they"
                f" differ in {values}: a change is the ablation's only if the ablation sets these."
            )
    return [for_line(text, _MAX_SENTENCE) for text in warnings]


def other_code(sweep: Sweep) -> list[str]:
    """Return a warning if other code has trained some of the cells."""
    first: dict[tuple[str, str], str] = {}  # part and its digest -> the first cell with it
    for cell_id, cell in sweep.done.items():
        for part, code in cell.identity.code.items():
            if part != "order":  # of the components, which differ
                first.setdefault((part, code), cell_id)
    by_part: dict[str, dict[str, str]] = {}
    for (part, code), cell_id in first.items():
        by_part.setdefault(part, {}).setdefault(canonical(part, code), cell_id)
    several = {part: [*of.values()] for part, of in by_part.items() if len(of) > 1}
    if not several:
        return []
    parts = "; ".join(f"{part} of {', '.join(cells)}" for part, cells in sorted(several.items()))
    text = (
        "The cells were trained by different code, and a change may be the code's. The first cells"
        f" of each version: {parts}."
    )
    return [for_line(text, _MAX_SENTENCE)]


def fewer_replicates(comparison: Comparison) -> list[str]:
    """Return a warning if the labels of a table of values have different replicates.

    Changes are of pairs. Values and scores by method are means over the cells that are done.
    """
    cells = comparison.cells[comparison.cells["state"] == "done"]
    lacking = []
    for (_, scene), rows in cells.groupby(["condition", "scene"], sort=False):
        own = rows.drop_duplicates(["label", *_REPLICATE])
        total, counts = len(own[_REPLICATE].drop_duplicates()), own.value_counts("label")
        fewer = [(label, counts[label]) for label in own["label"].unique()]
        lacking += [f"{label} on {scene} ({n} of {total})" for label, n in fewer if n < total]
        for metric in comparison.metrics:
            if metric.score is None or metric.optional:
                continue
            known = own.groupby("label", sort=False)[metric.name].agg(["count", "size"])
            partly = known[(known["count"] > 0) & (known["count"] < known["size"])]
            lacking += [
                f"{metric.label} of {label} on {scene} ({row['count']} of {row['size']})"
                for label, row in partly.iterrows()
            ]
    if not lacking:
        return []
    text = (
        "Values and scores by method are means over different replicates, and are not to be"
        f" compared where some are lacking: {listed(lacking)}. Changes are of pairs."
    )
    return [for_line(text, _MAX_SENTENCE)]


def _given(command: Sequence[str]) -> frozenset[str]:
    """Return the words of a command that set values of every cell, and so of the baseline too."""
    return frozenset(w.lstrip("+") for w in command if w.lstrip("+").startswith(_GIVEN))


def _settings(cell: DoneCell) -> dict[str, Any]:
    """Return the settings in a cell's identity, which lacks those that are off."""
    return dict(dotted({part: getattr(cell.identity, part) for part in _PARTS}))


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the keys of which the cells have different values, sorted."""
    keys = {key for of in settings for key in of} - _OWN
    first = settings[0]
    return sorted(key for key in keys if any(of.get(key) != first.get(key) for of in settings))


def _by_scene(key: str, sweep: Sweep, rows: pd.DataFrame) -> str:
    """Return a key with its values and their scenes: `train.steps 500 (fern), 600 (horns)`.

    A scene whose replicates have several values is named with each replicate.
    """
    values = [_value(sweep.done[cell_id], key) for cell_id in rows["cell_id"]]
    rows = rows.assign(shown=values)
    of_scene = rows.drop_duplicates(["scene", "shown"])["scene"].value_counts()
    found: dict[str, dict[str, None]] = {}
    for row in rows.to_dict("records"):
        replicate = f" {row['variant_seed']}/{row['seed']}" * bool(of_scene[row["scene"]] > 1)
        found.setdefault(row["shown"], {})[f"{row['scene']}{replicate}"] = None
    return f"{key} {', '.join(f'{value} ({listed([*of])})' for value, of in found.items())}"


def _value(cell: DoneCell, key: str) -> str:
    """Return the value of a key that some cells have in their identity."""
    value = _settings(cell).get(key)
    if value is None:
        value = cell.config
        for name in key.split("."):
            value = getattr(value, name, None)
    return "off" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
