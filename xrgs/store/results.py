"""Makes pandas tables of the files of cells, for `Store.cells`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from xrgs.composing import dotted
from xrgs.errors import StoreError, XrgsError
from xrgs.evaluation.metrics import METRICS
from xrgs.safeio.sanitize import for_line
from xrgs.store.cell_folder import CellFolder
from xrgs.store.schema import RecordedCell, Summary

#: The names of a cell in a sweep's record.
CELL_NAMES = ("scene", "label", "condition")
#: Groups of a cell's config that become columns; the others do not change a number.
_CONFIG_GROUPS = ("scene", "variant", "splat", "train", "components")


def cells_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of `Store.cells` of the values of `cell_columns`, `state` and `reason`."""
    rows = list(rows)
    metrics = [metric.name for metric in METRICS]
    leading = ["cell_id", *CELL_NAMES, "seed", "variant", "state", "reason", *metrics]
    config = dict.fromkeys(key for row in rows for key in row if key not in leading)
    table = pd.DataFrame(rows, columns=[*leading, *config])
    table[metrics] = table[metrics].astype("float64")
    table["seed"] = table["seed"].astype("Int64")
    return table.sort_values([*CELL_NAMES, "seed", "cell_id"], ignore_index=True)


def cell_columns(cell: CellFolder, names: RecordedCell | None) -> dict[str, Any]:
    """Return a cell's names, seed, variant and settings, as columns of a table.

    Columns of a file that is missing or damaged are missing or None. `names` is the cell's row in
    the record of a sweep.
    """
    identity = None
    with suppress(StoreError):
        identity = cell.identity()
    try:
        config = asdict(cell.config())
    except XrgsError:
        config = {}
    groups = {name: config[name] for name in _CONFIG_GROUPS if name in config}
    settings = {
        for_line(key): for_line(value) if isinstance(value, str) else value
        for key, value in dotted(groups)
    }
    return {
        **settings,
        "cell_id": cell.id,
        "scene": for_line(names.scene) if names else settings.get("scene.name"),
        "label": for_line(names.label) if names else None,
        "condition": for_line(names.condition) if names else None,
        "seed": identity.seed if identity else None,
        "variant": identity.variant if identity else None,
    }


def over_views(views: pd.DataFrame) -> pd.DataFrame:
    """Return the scores of each cell: means over its views, `psnr_pooled` and `psnr_worst`.

    `psnr_pooled` is the PSNR of the views' squared errors together, -10 log10(mean(10^(-PSNR/10))),
    in which each view counts once. A view that is far off counts for more in it than in the mean of
    PSNR. `psnr_worst` is the lowest PSNR. `views` has a row for each view: `cell_id`, `psnr` in dB,
    and a column for each other score. A score that one view lacks is NaN.
    """
    errors = 10 ** (-views["psnr"] / 10)
    grouped = views.assign(psnr_pooled=errors, psnr_worst=views["psnr"]).groupby("cell_id")
    means = grouped.mean()
    with np.errstate(divide="ignore"):  # an error of 0 gives infinite PSNR
        means["psnr_pooled"] = -10 * np.log10(means["psnr_pooled"])
    means["psnr_worst"] = grouped["psnr_worst"].min()
    return means.mask(grouped.count().lt(grouped.size(), axis=0))


def cell_metrics(summary: Summary, scores: pd.DataFrame) -> dict[str, float]:
    """Return the metrics of a finished cell by name: its figures, and `over_views` of its scores.

    `scores` are as `CellFolder.scores` returns them.
    """
    means = over_views(scores.assign(cell_id="")).iloc[0]
    figures = msgspec.structs.asdict(summary)
    whole = {m.name: float(figures[m.name]) for m in METRICS if figures.get(m.name) is not None}
    return whole | {m.name: float(means[m.name]) for m in METRICS if m.name in means}
