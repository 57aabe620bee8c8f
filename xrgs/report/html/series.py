"""The numbers of the page's curves and of its trade-off plot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.report import curves
from xrgs.report.html.content import RUN, finite, run_names, runs, shown, why
from xrgs.safeio.records import as_number, read_table

if TYPE_CHECKING:
    import pandas as pd

    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.report.compare import Comparison
    from xrgs.report.html.content import Content
    from xrgs.report.joined import JoinedStore

#: What a history counts, in the order of the page.
RULES = (
    "gaussians",
    "duplicated",
    "split",
    "pruned_opacity",
    "pruned_scale",
    "pruned_by_components",
    "pruned_non_finite",
)
#: The most rows of a history that are drawn, evenly spaced: a plot has few more pixels.
_MAX_ROWS = 240


def add_curves(content: Content, quality: pd.DataFrame) -> None:
    """Add the quality during training of each cell that was evaluated during training.

    Args:
        content: The content of the page.
        quality: The table that `xrgs.report.curves.joined` returns.
    """
    keys = [*RUN, "label"]
    for _, rows in quality.groupby(keys, sort=False):
        first = rows.iloc[0]
        columns = {name: [finite(value) for value in rows[name]] for name in curves.COLUMNS}
        content.curves.append(run_names(first) | {"label": shown(first["label"])} | columns)


def add_history(content: Content, store: JoinedStore, comparison: Comparison) -> None:
    """Add Gaussians over steps, and what each rule grew and pruned, of each finished cell.

    Args:
        content: The content of the page.
        store: The store with the histories.
        comparison: The comparison of the cells.
    """
    for rows in runs(comparison):
        for _, row in rows[~rows["cell_id"].isin(store.external)].iterrows():
            try:
                columns = _history(store.cell(row["cell_id"]))
            except (StoreError, ValueError) as error:
                label = f"{shown(row['scene'])}, {shown(row['label'])}"
                content.notes.append(f"{label}: no history, {why(error, store)}")
                continue
            content.history.append(run_names(row) | {"label": shown(row["label"])} | columns)


def _history(cell: CellFolder) -> dict[str, list[float | None]]:
    header, rows = read_table(cell.path / "history.csv")
    step = max(1, -(-len(rows) // _MAX_ROWS))
    kept = rows[::step] + (rows[-1:] if (len(rows) - 1) % step else [])
    found: dict[str, list[float | None]] = {}
    for name in ("step", *RULES):
        if name in header:
            place = header.index(name)
            found[name] = [finite(as_number(row[place])) for row in kept]
    return found


def add_trade_offs(content: Content, comparison: Comparison) -> None:
    """Add Gaussians and scores of each label and scene, as means over the replicates.

    Args:
        content: The content of the page.
        comparison: The comparison.
    """
    cells = comparison.cells
    done = cells[cells["state"] == "done"]
    names = ["gaussians", *VIEW_METRICS]
    means: Any = done.groupby(["condition", "scene", "label"], sort=False)[names].mean()
    for (condition, scene, label), row in means.iterrows():
        numbers: dict[str, Any] = {name: finite(row[name]) for name in names}
        texts = {"condition": shown(condition), "scene": shown(scene), "label": shown(label)}
        content.trade_offs.append(texts | numbers)
