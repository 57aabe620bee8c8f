"""Finds pairs whose change in PSNR is the work of one view.

A scene has few test views, and PSNR has no bound: a floater before one test camera can take 10 dB
from its view, and so more from the mean than all other views gain.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from xrgs.report.writing import signed
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from xrgs.report.compare import Comparison

_PAIR = ["label", "condition", "scene", "variant_seed", "seed"]
_CELLS = ["cell_id", "base_id"]
#: With fewer views, none can be told from the others.
_MIN_VIEWS = 3
#: A view decides where, without it, the mean change differs by more than this share of the mean and
#: by more than these dB, and where the view is this many times as far from the median of the other
#: views as the farthest of them. Our choice.
_MIN_SHARE = 0.5
_MIN_DB = 0.3
_MIN_DISTANCE = 3.0
#: The longest sentence, in characters.
_MAX_SHOWN = 240


def decided_by_one_view(
    comparison: Comparison, views: pd.DataFrame
) -> dict[tuple[str, str], list[str]]:
    """Say of which pairs one view decides the change in PSNR.

    Args:
        comparison: The pairs of cells.
        views: `Sweep.views`.

    Returns:
        By label and condition a sentence for each such pair, which names the view and has the
        change with it and without it.
    """
    changes = _changes_of_views(comparison, views)
    pairs = _with_and_without(changes)
    difference = (pairs["without"] - pairs["with_all"]).abs()
    decided = pairs[
        (pairs["n_views"] >= _MIN_VIEWS)
        & (difference > _MIN_SHARE * pairs["with_all"].abs())
        & (difference > _MIN_DB)
        & (pairs["distance"] > _MIN_DISTANCE * pairs["spread"])
    ]
    found: dict[tuple[str, str], list[str]] = {}
    for row in decided.to_dict("records"):
        text = (
            f"Caution: one view decides: on {row['scene']} (replicate"
            f" {row['variant_seed']}/{row['seed']}) PSNR changes by {signed(row['with_all'])} dB,"
            f" and without {row['view']} by {signed(row['without'])} dB"
        )
        found.setdefault((row["label"], row["condition"]), []).append(for_line(text, _MAX_SHOWN))
    return found


def _changes_of_views(comparison: Comparison, views: pd.DataFrame) -> pd.DataFrame:
    """Return the change in PSNR of each view of each pair, dB, where it is finite."""
    pairs = comparison.pairs.loc[comparison.pairs["metric"] == "psnr", [*_PAIR, *_CELLS]]
    scores = views[["cell_id", "view", "psnr"]]
    of_base = scores.rename(columns={"cell_id": "base_id", "psnr": "base_psnr"})
    pairs = pairs.drop_duplicates()  # a record may have a row twice
    rows = pairs.merge(scores, on="cell_id").merge(of_base, on=["base_id", "view"])
    with np.errstate(invalid="ignore"):  # inf - inf gives NaN, as it should
        rows["change"] = rows["psnr"] - rows["base_psnr"]
    finite: pd.DataFrame = rows[np.isfinite(rows["change"])].reset_index(drop=True)
    return finite


def _with_and_without(changes: pd.DataFrame) -> pd.DataFrame:
    """Return for each pair its mean change, and what it is without its most distant view.

    One row a pair: `view`, the most distant from the median of all; `n_views`; `with_all`, the
    mean of all; of the others `without`, their mean, and `spread`, the distance of the farthest of
    them from their median; `distance`, that of the view from it.
    """
    groups = changes.groupby(_PAIR, sort=False)["change"]
    far = (changes["change"] - groups.transform("median")).abs()
    alone = far.groupby([changes[key] for key in _PAIR], sort=False).idxmax()
    others = changes.drop(index=list(alone))
    rest = others.groupby(_PAIR, sort=False)["change"]
    spread = (others["change"] - rest.transform("median")).abs()
    pairs = changes.loc[alone].set_index(_PAIR)
    pairs = pairs.assign(
        n_views=groups.size(),
        with_all=groups.mean(),
        without=rest.mean(),
        distance=(pairs["change"] - rest.median()).abs(),
        spread=spread.groupby([others[key] for key in _PAIR], sort=False).max(),
    )
    return pairs.reset_index()
