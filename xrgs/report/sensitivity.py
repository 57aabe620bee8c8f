"""How changes depend on a setting: the labels of a sweep that differ in the value of one key.

The label of an ablation whose setting is swept has the value in it: `consistency.weight=0.05`, and
`densify densify.lr_grow=2 densify.lr_prune=1` where two settings are.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from xrgs.report.compare import is_amount

if TYPE_CHECKING:
    from collections.abc import Iterable

    from xrgs.report.compare import Comparison

#: The fewest values of a setting that show how a change depends on it.
_MIN_VALUES = 3
#: The largest value of a setting that an axis can show: the space beside it needs more of float64.
_MAX_SHOWN = 1e100
_POINT = ["label", "scene", "metric", "change"]


def sensitivities(comparison: Comparison, condition: str) -> dict[str, pd.DataFrame]:
    """Return how the changes depend on each numeric setting that was swept.

    Args:
        comparison: The pairs of cells and their means.
        condition: The condition that the cells were run under.

    Returns:
        By the setting's key, for each that has at least three values: one row for each change in %,
        with `level` (`pair`, `scene` or `mean`), `scene` (missing for a mean), `metric`, `change`,
        `value` (of the setting) and `series` (the rest of the label, equal for what is one curve).
    """
    changes = _changes(comparison, condition)
    found = {}
    for key, places in _settings(changes["label"].unique()).items():
        rows = changes.merge(places, on="label")
        values = rows.groupby("series")["value"].transform("nunique")
        if (values >= _MIN_VALUES).any():
            found[key] = rows[values >= _MIN_VALUES].sort_values("value", kind="stable")
    return found


def _changes(comparison: Comparison, condition: str) -> pd.DataFrame:
    """Return the changes of pairs, of scenes and of the means in percent, in one table."""
    pairs = comparison.pairs
    amounts = {metric.name for metric in comparison.metrics if is_amount(metric)}
    percent = np.where(
        pairs["metric"].isin(amounts), 100 * np.expm1(pairs["effect"]), pairs["effect"]
    )
    levels = {
        "pair": pairs.assign(change=percent),
        "scene": comparison.per_scene.reset_index(),
        "mean": comparison.means.reset_index().assign(scene=None),
    }
    tables = [
        table.loc[table["condition"] == condition, _POINT].assign(level=level)
        for level, table in levels.items()
    ]
    return pd.concat(tables, ignore_index=True)


def _settings(labels: Iterable[str]) -> dict[str, pd.DataFrame]:
    """Return the numeric settings of labels: by the key, `label`, `series` and `value`."""
    found: dict[str, list[tuple[str, str, float]]] = {}
    for label in labels:
        words = label.split(" ")
        for at, word in enumerate(words):
            key, _, text = word.partition("=")
            if abs(value := _number(text)) <= _MAX_SHOWN:
                rest = " ".join(words[:at] + words[at + 1 :])
                found.setdefault(key, []).append((label, rest, value))
    columns = ["label", "series", "value"]
    return {key: pd.DataFrame(rows, columns=columns) for key, rows in found.items()}


def _number(text: str) -> float:
    """Return the number that a text is; NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan
