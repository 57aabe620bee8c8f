"""Fits the growth of rendering time with the number of Gaussians and the number of pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import linregress

from xrgs.bench.timing import Row

ALL_LOADS = "all loads"


def fit_growth(rows: Sequence[Row]) -> list[Row]:
    """Fit power laws to the times of the first method on one thread.

    Returns:
        A row for each growing quantity (`grows`: "Gaussians" or "pixels") and each size of the
        other quantity (`at`), with `sizes` in ascending order, `ms` (forward plus backward), and
        the `exponent` of the power law: 1 if doubling the size doubles the time. The last two rows
        are for a fit to all loads. Quantities that do not vary have no rows.
    """
    frame = pd.DataFrame(rows)
    frame = frame[(frame["method"] == rows[0]["method"]) & (frame["threads"] == 1)]
    frame = pd.DataFrame(
        {
            "Gaussians": frame["gaussians"],
            "pixels": frame["width"] * frame["height"],
            "size": frame["width"].astype(str) + "x" + frame["height"].astype(str),
            "count": frame["gaussians"].map("{:,} Gaussians".format),
            "ms": frame["forward_ms"] + frame["backward_ms"],
        }
    )
    fits: list[Row] = []
    for grows, fixed, name in (("Gaussians", "pixels", "size"), ("pixels", "Gaussians", "count")):
        for _, group in frame.sort_values(grows).groupby(fixed):
            if len(group) > 1:
                fit = linregress(np.log(group[grows]), np.log(group["ms"]))
                row = {"grows": grows, "at": group[name].iloc[0], "sizes": group[grows].tolist()}
                fits.append(row | {"ms": group["ms"].tolist(), "exponent": float(fit.slope)})
    if len({row["grows"] for row in fits}) == 2:
        columns = [np.ones(len(frame)), np.log(frame["Gaussians"]), np.log(frame["pixels"])]
        _, *slopes = np.linalg.lstsq(np.stack(columns, axis=1), np.log(frame["ms"]), rcond=None)[0]
        for grows, slope in zip(("Gaussians", "pixels"), slopes, strict=True):
            fits.append({"grows": grows, "at": ALL_LOADS, "exponent": float(slope)})
    return fits
