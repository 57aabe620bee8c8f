"""Decides which pictures a report has, and reads their images from the store."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

import pandas as pd

from xrgs.capture import images
from xrgs.capture.images import ImageError
from xrgs.errors import StoreError, UnreadableError
from xrgs.experiment.store import BASELINE
from xrgs.report.collect import ReportError
from xrgs.report.figures import Panel, curves, differing_crop, side_by_side, trade_off
from xrgs.report.tables import titled
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.words import for_file_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from xrgs.evaluation.metrics import Metric
    from xrgs.experiment.store import Store
    from xrgs.report.compare import Comparison
    from xrgs.safeio.confined import ConfinedPath

    _Drawing = Callable[[ConfinedPath], "Picture"]  # draws into the file

_CURVES = {"gaussians": "Gaussians", "loss": "loss of the step's view, as each run weighs it"}
#: Largest image that is drawn: three are in memory at a time, 12 bytes a pixel, and their drawing.
_MAX_PIXELS = 1 << 24
#: The most pictures that are drawn without being asked for by name; each takes up to a second.
_MAX_PICTURES = 100
#: The most ablations that one figure of trade-offs can name.
_MAX_ABLATIONS = 200


@dataclass(frozen=True)
class Picture:
    """The file of a figure, or the reason why there is none."""

    title: str
    file: ConfinedPath | None
    why: str = ""


def draw(
    store: Store,
    comparison: Comparison,
    views: pd.DataFrame,
    folder: ConfinedPath,
    names: Sequence[str] | None = None,
) -> list[Picture]:
    """Draw what each ablation trades, and views and training curves of each scene and ablation.

    The trade-offs are drawn where there are several ablations, one figure for each condition. The
    other pictures show the first condition and replicate, which their titles name.

    Args:
        store: The store with the photographs, renders and histories.
        comparison: The pairs of cells.
        views: The table `Sweep.views`.
        folder: The existing folder to write the files to.
        names: Names of the pictures to draw, which are file names without suffix; None draws all,
            but no more than the first 100.

    Returns:
        The pictures, in the order of the tables.

    Raises:
        ReportError: There is no picture of such a name.
    """
    first = comparison.pairs.sort_values(["variant_seed", "seed"], kind="stable")
    pairs = first.drop_duplicates(["scene", "label"]).sort_values(["scene", "label"])
    shown = {*pairs["cell_id"], *pairs["baseline_id"]}
    scores = views[views["cell_id"].isin(shown)].groupby("cell_id")
    psnr = {cell_id: rows.set_index("view")["psnr"] for cell_id, rows in scores}
    cells = comparison.cells.drop_duplicates("cell_id").set_index("cell_id")
    drawings = _trade_offs(comparison)
    for _, pair in pairs.iterrows():
        both = _same_views(psnr.get(pair["baseline_id"]), psnr.get(pair["cell_id"]))
        cell = cells.loc[pair["cell_id"]]
        split = "train" if cell["validation"] > 0 else "test"
        photographs = store.variants / cell["variant_id"] / "images" / split
        stem = f"{for_file_name(pair['scene'])}--{for_file_name(pair['label'])}"
        drawings[stem] = partial(_views, store, pair, both, photographs)
        drawings[f"{stem}--training"] = partial(_training, store, pair)
    first_ones = dict(islice(drawings.items(), _MAX_PICTURES))
    chosen = first_ones if names is None else _chosen(drawings, names)
    bar = progress(chosen.items(), "drawing", "picture", len(chosen))
    drawn = [drawing(folder / f"{name}.png") for name, drawing in bar]
    if names is None and len(chosen) < len(drawings):
        why = f"only the first {len(chosen)} are drawn; pictures=NAMES draws others"
        drawn.append(Picture(f"{len(drawings) - len(chosen)} more", None, why))
    return drawn


def _same_views(
    baseline: pd.Series | None, ablation: pd.Series | None
) -> tuple[pd.Series, pd.Series]:
    """Return the PSNR of the views that both cells have, in their order; perhaps of none."""
    if baseline is None or ablation is None:
        return pd.Series(dtype=float), pd.Series(dtype=float)
    both = ablation.index[ablation.index.isin(baseline.index)]
    return baseline[both], ablation[both]


def _chosen(drawings: dict[str, _Drawing], names: Sequence[str]) -> dict[str, _Drawing]:
    """Return the drawings of these names."""
    for name in names:
        if name not in drawings:
            choices = ", ".join(drawings) or "none"
            raise ReportError(
                f"pictures={name}: there is no picture of that name; choose from: {choices}"
            )
    return {name: drawing for name, drawing in drawings.items() if name in names}


def _trade_offs(comparison: Comparison) -> dict[str, _Drawing]:
    """Return the trade-off figures, one for each condition with several ablations."""
    drawings: dict[str, _Drawing] = {}
    for condition in dict.fromkeys(condition for _, condition in comparison.groups):
        means, scenes = (
            _traded(table, condition, comparison.metrics)
            for table in (comparison.means, comparison.per_scene)
        )
        axes = [m for m in comparison.metrics if m.score is not None and m.name in means]
        if not 2 <= len(means) <= _MAX_ABLATIONS or not axes:
            continue
        title = titled("What each ablation trades, mean over scenes", condition)
        name = f"trade-off{condition and f'.{for_file_name(condition)}'}"
        drawings[name] = partial(_trade_off, title, means, scenes, axes)
    return drawings


def _trade_off(
    title: str,
    means: pd.DataFrame,
    scenes: pd.DataFrame,
    axes: Sequence[Metric],
    file: ConfinedPath,
) -> Picture:
    with atomic_writer(file) as stream:
        stream.write(trade_off(title, means, scenes, axes))
    return Picture(title, file)


def _traded(table: pd.DataFrame, condition: str, metrics: Sequence[Metric]) -> pd.DataFrame:
    """Return Gaussians as a multiple of the baseline's, and the change of each measured score.

    The index is the label. Scores in decibels change by their difference, others in percent. A
    label that lacks a score has no row; the tables say why.
    """
    here = table[table.index.get_level_values("condition") == condition].droplevel("condition")
    of = here.index.get_level_values("metric")
    columns = {"gaussians": 1 + here.loc[of == "gaussians", "change"].droplevel("metric") / 100}
    for metric in metrics:
        if metric.score is not None:
            how = "difference" if metric.unit == "dB" else "change"
            columns[metric.name] = here.loc[of == metric.name, how].droplevel("metric")
    wide = pd.DataFrame(columns).dropna(axis="columns", how="all").dropna()
    return wide.reset_index().set_index("label")


def median_view(baseline: pd.Series, ablation: pd.Series) -> str:
    """Return the view whose change of PSNR is the median: neither the best nor the worst case.

    Args:
        baseline: PSNR of the baseline in dB, indexed by view.
        ablation: PSNR of the ablation in dB, indexed by view.

    Returns:
        The name of the view; of an even number of views, the lower of the two in the middle.
    """
    change = (ablation - baseline.reindex(ablation.index)).fillna(0.0).sort_index()
    return str(change.sort_values(kind="stable").index[(len(change) - 1) // 2])


def _views(
    store: Store,
    pair: pd.Series,
    psnr: tuple[pd.Series, pd.Series],
    photographs: ConfinedPath,
    file: ConfinedPath,
) -> Picture:
    if psnr[0].empty:
        return Picture(_title(pair), None, "the two cells have no scored view in common")
    view = median_view(*psnr)
    title = f"{_title(pair)}: view {view}, by change of PSNR the median of {len(psnr[0])}"
    name = f"{view}.png"
    try:
        truth = _image(photographs / name)
        baseline = _image(store.cell(pair["baseline_id"]).folder / "renders" / name)
        ablation = _image(store.cell(pair["cell_id"]).folder / "renders" / name)
    except ReportError as error:
        return Picture(title, None, str(error))
    panels = (
        Panel(truth, "photograph", f"{truth.shape[1]} × {truth.shape[0]} px"),
        Panel(baseline, BASELINE, f"PSNR {psnr[0][view]:.2f} dB"),
        Panel(ablation, str(pair["label"]), f"PSNR {psnr[1][view]:.2f} dB"),
    )
    if len({panel.image.shape for panel in panels}) > 1:
        return Picture(title, None, f"{view}: photograph and renders differ in size")
    note = f"where baseline and {pair['label']} differ most"
    with atomic_writer(file) as stream:
        stream.write(side_by_side(title, panels, differing_crop(baseline, ablation), note))
    return Picture(title, file)


def _training(store: Store, pair: pd.Series, file: ConfinedPath) -> Picture:
    title = f"{_title(pair)}: training"
    runs = []
    for name, key in ((BASELINE, "baseline_id"), (str(pair["label"]), "cell_id")):
        try:
            runs.append((name, store.cell(pair[key]).history()[["step", *_CURVES]]))
        except (StoreError, KeyError):
            return Picture(title, None, f"cells/{pair[key]}/history.csv can't be read")
    with atomic_writer(file) as stream:
        stream.write(curves(title, runs, _CURVES))
    return Picture(title, file)


def _title(pair: pd.Series) -> str:
    parts = (pair["scene"], pair["label"], pair["condition"], f"seed {pair['seed']}")
    return ", ".join(str(part) for part in parts if part)


def _image(file: ConfinedPath) -> NDArray[np.float32]:
    try:
        return images.read_png(file, max_pixels=_MAX_PIXELS)
    except (UnreadableError, ImageError) as error:
        # The path inside the store: the report is the same wherever the store is.
        raise ReportError(f"{'/'.join(file.parts)} can't be read") from error
