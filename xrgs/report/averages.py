"""Averages pairs over the replicates of each scene, then over scenes, with intervals and tests.

Averages are taken of the effect of a pair: log(value / base) for amounts, a percentage for all
else. `xrgs.report.compare` says what the averages mean.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from xrgs.report.inference import false_discovery_rates, half_width, p_values

if TYPE_CHECKING:
    from collections.abc import Collection

_SCENE = ["label", "condition", "scene", "metric"]
_MEAN = ["label", "condition", "metric"]
#: Columns that are computed in the scale of the effect, and then are in percent.
_EFFECTS = ["change", "low", "high", "scatter_replicates", "scatter_scenes"]


def averaged(pairs: pd.DataFrame, ratios: Collection[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return means of pairs over the replicates of each scene, and means over scenes.

    Args:
        pairs: One row for each metric of each pair: `label`, `condition`, `scene`, `metric`,
            `base`, `value`, `difference`, `effect`, and `why` there is no effect.
        ratios: Names of the metrics with the logarithm of a ratio as their effect.

    Returns:
        Two tables, indexed by label, condition, scene, metric, and by label, condition, metric.
        `base`, `value` and `difference` are means over the pairs that have an effect. `change`,
        its 95 % interval `low` to `high`, and the standard deviations `scatter_replicates` (pooled
        within scenes) and `scatter_scenes` (of the scenes' means) are in percent; a deviation of
        logarithms is 100 (exp(deviation) - 1). The interval and `p` are of `n` values of the kind
        `unit` (`scenes`, or `replicates` where there is one scene). `scenes` counts the scenes that
        have an effect. `q` is p corrected for all rows of a condition, and NaN in the first table.
        `agree` counts the `pairs` that changed in the direction of their mean. `why` says why some
        have no effect.
    """
    scenes = _means(pairs, _SCENE).assign(unit="replicates", q=np.nan)
    scenes = scenes.assign(
        scatter_replicates=scenes["spread"], scatter_scenes=np.nan, scenes=scenes["n"].clip(upper=1)
    )
    means = _over_scenes(scenes.reset_index())
    means, scenes = _with_interval(means), _with_interval(scenes)
    by_condition = means.groupby("condition")["p"]
    means["q"] = by_condition.transform(lambda p: false_discovery_rates(p.to_numpy(np.float64)))
    scenes, means = _with_agreement(scenes, pairs), _with_agreement(means, pairs)
    return _in_percent(scenes, ratios), _in_percent(means, ratios)


def _means(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Return the means of the rows that share the keys `by`, `spread` and `n` of their effects.

    Rows without an effect are left out of every mean; `why` says why they have none.
    """
    known = rows["effect"].notna()
    numbers = ["base", "value", "difference"]
    grouped = rows.assign(**rows[numbers].where(known)).groupby(by, sort=False)
    table = grouped[[*numbers, "effect"]].mean()
    incomplete = rows[rows["why"] != ""].drop_duplicates([*by, "why"])
    why = incomplete.groupby(by, sort=False)["why"].agg("; ".join)
    return table.assign(
        spread=grouped["effect"].std(),
        n=grouped["effect"].count(),
        why=why.reindex(table.index).fillna(""),
    )


def _over_scenes(scenes: pd.DataFrame) -> pd.DataFrame:
    """Return means over scenes; a single scene keeps its own values, which are replicates."""
    means = _means(scenes, _MEAN)
    means = means.assign(scatter_scenes=means["spread"], scenes=means["n"], unit="scenes")
    freedom = (scenes["n"] - 1).clip(lower=0)
    squares = scenes.assign(squares=freedom * scenes["spread"] ** 2, freedom=freedom)
    pooled = squares.groupby(_MEAN, sort=False)[["squares", "freedom"]].sum()
    means["scatter_replicates"] = np.sqrt(pooled["squares"] / pooled["freedom"])  # NaN for 0 / 0
    only = scenes[scenes["effect"].notna()].drop_duplicates(_MEAN, keep=False).set_index(_MEAN)
    columns = ["spread", "n", "unit"]
    means.loc[only.index, columns] = only[columns]
    return means


def _with_interval(means: pd.DataFrame) -> pd.DataFrame:
    """Return the means with `change`, the effect, its interval `low` to `high`, and `p`."""
    names = ("effect", "spread", "n")
    effect, spread, n = (means[name].to_numpy(np.float64) for name in names)
    half = half_width(spread, n)
    return means.assign(
        change=effect, low=effect - half, high=effect + half, p=p_values(effect, spread, n)
    )


def _with_agreement(means: pd.DataFrame, pairs: pd.DataFrame) -> pd.DataFrame:
    """Return the means with `pairs`, how many are behind each, and how many `agree` in sign."""
    by = list(means.index.names)
    known = pairs[pairs["effect"].notna()]
    mean = known[by].merge(means["effect"].reset_index(), on=by, how="left")["effect"]
    agree = np.sign(known["effect"].to_numpy()) == np.sign(mean.to_numpy())
    counts = known.assign(agree=agree).groupby(by)["agree"].agg(agree="sum", pairs="count")
    return means.join(counts).fillna({"agree": 0, "pairs": 0}).astype({"agree": int, "pairs": int})


def _in_percent(means: pd.DataFrame, ratios: Collection[str]) -> pd.DataFrame:
    """Return the means with all effects in percent; some are logarithms of ratios before."""
    is_ratio = means.index.get_level_values("metric").isin(ratios)
    with np.errstate(over="ignore"):  # an interval of two values may end at infinity
        return means.assign(
            **{name: np.where(is_ratio, 100 * np.expm1(means[name]), means[name])
               for name in _EFFECTS}
        )  # fmt: skip
