"""Scores of a cell, from the scores of its views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd


def over_views(views: pd.DataFrame) -> pd.DataFrame:
    """Return the scores of each cell.

    `psnr_pooled` is the PSNR of the views' squared errors together, -10 log10(mean(10^(-PSNR/10))),
    in which each view counts once. A view that is far off counts for more in it than in the mean of
    PSNR. `psnr_worst` is the lowest PSNR.

    Args:
        views: One row for each view: `cell_id`, `psnr` in dB, and a column for each other score.

    Returns:
        One row for each cell, indexed by its id: the mean of each score over the views,
        `psnr_pooled` and `psnr_worst`. A score that one view lacks is NaN.
    """
    errors = 10 ** (-views["psnr"] / 10)
    grouped = views.assign(psnr_pooled=errors, psnr_worst=views["psnr"]).groupby("cell_id")
    means = grouped.mean()
    with np.errstate(divide="ignore"):  # no error at all is infinite PSNR
        means["psnr_pooled"] = -10 * np.log10(means["psnr_pooled"])
    means["psnr_worst"] = grouped["psnr_worst"].min()
    return means.mask(grouped.count().lt(grouped.size(), axis=0))
