"""Averages pairs over the replicates of each scene, then over scenes, with intervals and tests.

Averages are taken of the effect of a pair: a difference in dB, or log(value / base). The module
`xrgs.report.compare` says what the averages mean.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pandas as pd

from xrgs.report.inference import half_width, p_values, prediction_half_width, sign_test

_SCENE = ["label", "condition", "scene", "metric"]
_MEAN = ["label", "condition", "metric"]
#: Columns in the unit of the effect, which are shown in percent if the effect is a logarithm.
_EFFECTS = [
    *("change", "low", "high", "new_low", "new_high"),
    *("scatter_replicates", "scatter_scenes"),
]


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
    scenes = _means(pairs, _SCENE)
    scenes = scenes.assign(
        unit="replicates",
        scenes=scenes["n"].clip(upper=1),
        pairs=scenes["n"],
        scatter_replicates=scenes["spread"],
        scatter_scenes=np.nan,
    )
    means = _over_scenes(scenes.reset_index())
    return _with_tests(scenes, ratios), _with_tests(means, ratios)


def _means(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Return the means of the rows that share the keys `by`, with `spread`, `n`, `up` and `down`.

    Rows without an effect are left out of every mean; `why` says why they have none.
    """
    has_effect = rows["effect"].notna()
    numbers = ["base", "value"]
    signs = {"up": rows["effect"] > 0, "down": rows["effect"] < 0}
    grouped = rows.assign(**rows[numbers].where(has_effect), **signs).groupby(by, sort=False)
    table = grouped[[*numbers, "effect"]].mean()
    incomplete = rows[rows["why"] != ""].drop_duplicates([*by, "why"])
    why = incomplete.groupby(by, sort=False)["why"].agg("; ".join)
    return table.assign(
        spread=grouped["effect"].std(),
        n=grouped["effect"].count(),
        up=grouped["up"].sum(),
        down=grouped["down"].sum(),
        why=why.reindex(table.index).fillna(""),
    )


def _over_scenes(scenes: pd.DataFrame) -> pd.DataFrame:
    """Return means over scenes; a single scene keeps its own values, which are replicates."""
    means = _means(scenes, _MEAN)
    means = means.assign(scatter_scenes=means["spread"], scenes=means["n"], unit="scenes")
    means["pairs"] = scenes.groupby(_MEAN, sort=False)["pairs"].sum()
    freedom = (scenes["n"] - 1).clip(lower=0)
    squares = scenes.assign(squares=freedom * scenes["spread"] ** 2, freedom=freedom)
    pooled = squares.groupby(_MEAN, sort=False)[["squares", "freedom"]].sum()
    means["scatter_replicates"] = np.sqrt(pooled["squares"] / pooled["freedom"])  # NaN for 0 / 0
    single = scenes[scenes["effect"].notna()].drop_duplicates(_MEAN, keep=False).set_index(_MEAN)
    columns = ["spread", "n", "up", "down", "unit"]
    means.loc[single.index, columns] = single[columns]
    return means


def _with_tests(means: pd.DataFrame, ratios: Collection[str]) -> pd.DataFrame:
    """Return the means with changes, intervals and the p of their tests, not yet corrected."""
    names = ("effect", "spread", "n", "up", "down")
    effect, spread, n, up, down = (means[name].to_numpy(np.float64) for name in names)
    half = half_width(spread, n)
    new = np.where(means["unit"] == "scenes", prediction_half_width(spread, n), np.nan)
    means = means.assign(
        change=effect,
        low=effect - half,
        high=effect + half,
        new_low=effect - new,
        new_high=effect + new,
        p=p_values(effect, spread, n),
        p_sign=sign_test(up, down),
    )
    is_ratio = means.index.get_level_values("metric").isin(ratios)
    with np.errstate(over="ignore"):  # an interval of two values may end at infinity
        percent = {name: 100 * np.expm1(means[name]) for name in _EFFECTS}
    return means.assign(
        **{name: np.where(is_ratio, percent[name], means[name]) for name in _EFFECTS}
    )
