"""Averages pairs over the replicates of each scene, then over scenes, with intervals and tests.

Averages are taken of the effect of a pair: a difference in dB, or log(value / base). The module
`xrgs.report.compare` says what the averages mean.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from xrgs.report.inference import half_width, p_values, prediction_half_width, sign_test

_SCENE = ["label", "condition", "scene", "metric"]
_MEAN = ["label", "condition", "metric"]
_AVERAGED = ["base", "value", "effect"]
_COUNTS = ["n", "up", "down", "scenes", "pairs"]
_SCATTERS = ["scatter_replicates", "scatter_scenes"]
#: Columns in the unit of the effect, which are shown in percent if the effect is a logarithm.
_EFFECTS = ["change", "low", "high", "new_low", "new_high", *_SCATTERS]

_Row = dict[str, Any]


def averaged(pairs: pd.DataFrame, ratios: Collection[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return means of pairs over the replicates of each scene, and means over scenes.

    Args:
        pairs: One row for each metric of each pair: `label`, `condition`, `scene`, `metric`,
            `base`, `value`, `effect`, and `why` there is no effect.
        ratios: Names of the metrics whose effect is the logarithm of a ratio.

    Returns:
        Two tables, indexed by label, condition, scene, metric, and by label, condition, metric.

        `base` and `value` are means over the pairs that have an effect. `effect` and `spread` are
        mean and standard deviation of `n` values. `unit` says which: `scenes`, the scenes' means,
        or `replicates` if there is one scene. `up` and `down` count values above and below 0.
        `scenes` and `pairs` count those with an effect, and `why` says why others have none.

        `change` is the effect, with its 95 % interval `low` to `high`; `new_low` to `new_high` is
        the interval for one more scene. `scatter_replicates` (pooled within scenes) and
        `scatter_scenes` (of the scenes' means) are standard deviations. All of them are in percent
        for `ratios`: 100 (exp(x) - 1).

        `p` belongs to the t-test of the interval, `p_sign` to the sign test.
    """
    rows = pairs[[*_SCENE, *_AVERAGED, "why"]].to_dict("records")
    scenes = [_over_replicates(of) for of in _grouped(rows, _SCENE)]
    means = [_over_scenes(of) for of in _grouped(scenes, _MEAN)]
    return _with_tests(scenes, _SCENE, ratios), _with_tests(means, _MEAN, ratios)


def _grouped(rows: Iterable[_Row], by: list[str]) -> Iterable[list[_Row]]:
    """Return the rows that share the keys `by`, in the order of the first ones."""
    groups: dict[tuple[str, ...], list[_Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    return groups.values()


def _mean(rows: Sequence[_Row]) -> _Row:
    """Return the means of rows, with `spread`, `n`, `up` and `down`, and the keys of the first.

    Rows without an effect are left out of every mean; `why` says why they have none.
    """
    complete = [row for row in rows if not math.isnan(row["effect"])]
    effects, n = [row["effect"] for row in complete], len(complete)
    means = {name: _sum(row[name] for row in complete) / n if n else np.nan for name in _AVERAGED}
    return (
        {name: rows[0][name] for name in _SCENE}
        | means
        | {
            "spread": _deviation(effects),
            "n": n,
            "up": sum(effect > 0 for effect in effects),
            "down": sum(effect < 0 for effect in effects),
            "why": "; ".join(dict.fromkeys(row["why"] for row in rows if row["why"])),
        }
    )


def _over_replicates(pairs: Sequence[_Row]) -> _Row:
    """Return means over the pairs of a scene."""
    mean = _mean(pairs)
    mean |= {"unit": "replicates", "scenes": min(mean["n"], 1), "pairs": mean["n"]}
    return mean | {"scatter_replicates": mean["spread"], "scatter_scenes": np.nan}


def _over_scenes(scenes: Sequence[_Row]) -> _Row:
    """Return means over scenes; a single scene keeps its own values, which are replicates."""
    mean = _mean(scenes)
    several = [scene for scene in scenes if scene["n"] > 1]
    squares = _sum((scene["n"] - 1) * scene["spread"] ** 2 for scene in several)
    freedom = sum(scene["n"] - 1 for scene in several)
    pooled = math.sqrt(squares / freedom) if several else np.nan
    mean |= {"unit": "scenes", "scenes": mean["n"], "pairs": sum(s["pairs"] for s in scenes)}
    mean |= {"scatter_replicates": pooled, "scatter_scenes": mean["spread"]}
    if mean["n"] == 1:
        (single,) = (scene for scene in scenes if scene["n"])
        mean |= {name: single[name] for name in ("spread", "n", "up", "down", "unit")}
    return mean


def _sum(values: Iterable[float]) -> float:
    """Return Kahan's sum, which is what pandas computes."""
    total = lost = 0.0
    for value in values:
        exact = value - lost
        lost = (total + exact) - total - exact
        total += exact
    return total


def _deviation(values: Sequence[float]) -> float:
    """Return Welford's sample standard deviation, as pandas does; NaN for fewer than two values."""
    mean = squares = 0.0
    for n, value in enumerate(values, 1):
        off = value - mean
        mean += off / n
        squares += off * (value - mean)
    return math.sqrt(squares / (len(values) - 1)) if len(values) > 1 else np.nan


def _with_tests(rows: Sequence[_Row], by: list[str], ratios: Collection[str]) -> pd.DataFrame:
    """Return rows as a table, with changes, intervals and the p of their tests, not corrected."""
    kinds = dict.fromkeys([*_AVERAGED, "spread", *_SCATTERS], float) | dict.fromkeys(_COUNTS, int)
    table: dict[str, Any] = {
        name: np.array([row[name] for row in rows], dtype=kinds.get(name, object))
        for name in (*by, *kinds, "unit", "why")
    }
    effect, spread, n = table["effect"], table["spread"], table["n"].astype(float)
    half = half_width(spread, n)
    new = np.where(table["unit"] == "scenes", prediction_half_width(spread, n), np.nan)
    table |= {
        "change": effect,
        "low": effect - half,
        "high": effect + half,
        "new_low": effect - new,
        "new_high": effect + new,
        "p": p_values(effect, spread, n),
        "p_sign": sign_test(table["up"], table["down"]),
    }
    is_ratio = np.isin(table["metric"], list(ratios))
    with np.errstate(over="ignore"):  # an interval of two values may end at infinity
        for name in _EFFECTS:
            table[name] = np.where(is_ratio, 100 * np.expm1(table[name]), table[name])
    return pd.DataFrame(table).set_index(by)
