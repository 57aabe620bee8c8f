"""Which pictures a report has, and where their images lie in the store."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import pandas as pd

from xrgs.capture import images
from xrgs.capture.images import ImageError
from xrgs.experiment.store import BASELINE
from xrgs.report.collect import ReportError
from xrgs.report.figures import Panel, curves, differing_crop, side_by_side, trade_off
from xrgs.report.tables import titled
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import atomic_writer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from xrgs.evaluation.metrics import Metric
    from xrgs.experiment.store import Store
    from xrgs.report.compare import Comparison

    _Drawing = Callable[[Path], "Picture"]  # into a file of that name

_CURVES = {"gaussians": "Gaussians", "loss": "loss of the step's view, as each run weighs it"}
#: Of a photograph in a picture that is a thousand pixels wide; three are in memory at a time.
_MOST_PIXELS = 50_000_000


@dataclass(frozen=True)
class Picture:
    """A figure's file, or why there is none."""

    title: str
    file: Path | None
    why: str = ""


def draw(
    store: Store,
    comparison: Comparison,
    views: pd.DataFrame,
    folder: Path,
    names: Sequence[str] | None = None,
) -> list[Picture]:
    """What each ablation trades; then views and training curves of every scene and ablation.

    The first is drawn where there are several ablations, once a condition. Of several conditions
    and seeds the others show the first; the title says which.

    Args:
        store: where photographs, renders and histories lie.
        comparison: the pairs.
        views: `Sweep.views`.
        folder: where the files go; it exists.
        names: of the pictures that are wanted, a file's without its suffix; None for all.

    Returns:
        The pictures in the order of the tables.

    Raises:
        ReportError: there is none of such a name.
    """
    first = comparison.pairs.sort_values("seed", kind="stable")
    wanted = first.drop_duplicates(["scene", "label"]).sort_values(["scene", "label"])
    shown = {*wanted["cell_id"], *wanted["baseline_id"]}
    scores = views[views["cell_id"].isin(shown)].groupby("cell_id")
    psnr = {cell_id: rows.set_index("view")["psnr"] for cell_id, rows in scores}
    variants = comparison.cells.drop_duplicates("cell_id").set_index("cell_id")["variant_id"]
    known = _trade_offs(comparison)
    for _, pair in wanted.iterrows():
        both = psnr[pair["baseline_id"]], psnr[pair["cell_id"]]
        photographs = store.variants / variants[pair["cell_id"]] / "images" / "test"
        stem = f"{slug(pair['scene'])}--{slug(pair['label'])}"
        known[stem] = partial(_views, store, pair, both, photographs)
        known[f"{stem}--training"] = partial(_training, store, pair)
    chosen = known if names is None else _chosen(known, names)
    bar = progress(chosen.items(), "drawing", "picture", len(chosen))
    return [drawing(folder / f"{name}.png") for name, drawing in bar]


def _chosen(known: dict[str, _Drawing], names: Sequence[str]) -> dict[str, _Drawing]:
    for name in names:
        if name not in known:
            there = ", ".join(known) or "none at all"
            raise ReportError(f"pictures={name}: there is none of that name; there are: {there}")
    return {name: drawing for name, drawing in known.items() if name in names}


def _trade_offs(comparison: Comparison) -> dict[str, _Drawing]:
    drawings: dict[str, _Drawing] = {}
    for condition in dict.fromkeys(condition for _, condition in comparison.groups):
        means, scenes = (
            _traded(table, condition, comparison.metrics)
            for table in (comparison.means, comparison.per_scene)
        )
        axes = [m for m in comparison.metrics if m.score is not None and m.name in means]
        if len(means) < 2 or not axes:
            continue
        title = titled("What each ablation trades, mean over scenes", condition)
        name = f"trade-off{condition and f'.{slug(condition)}'}"
        drawings[name] = partial(_trade_off, title, means, scenes, axes)
    return drawings


def _trade_off(
    title: str, means: pd.DataFrame, scenes: pd.DataFrame, axes: Sequence[Metric], file: Path
) -> Picture:
    with atomic_writer(file) as stream:
        stream.write(trade_off(title, means, scenes, axes))
    return Picture(title, file)


def _traded(table: pd.DataFrame, condition: str, metrics: Sequence[Metric]) -> pd.DataFrame:
    """Gaussians over the baseline's, and the change of every score of views that was measured.

    Indexed by label. Decibels differ, other scores change in percent. A label that lacks one of
    them has no row: the tables say why.
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
    """The view whose change of PSNR is the (lower) median: neither the best nor the worst case.

    Args:
        baseline: PSNR in dB, indexed by view.
        ablation: likewise.
    """
    change = (ablation - baseline.reindex(ablation.index)).fillna(0.0).sort_index()
    return str(change.sort_values(kind="stable").index[(len(change) - 1) // 2])


def _views(
    store: Store,
    pair: pd.Series,
    psnr: tuple[pd.Series, pd.Series],
    photographs: Path,
    file: Path,
) -> Picture:
    view = median_view(*psnr)
    title = f"{_title(pair)}: view {view}, by change of PSNR the median of {len(psnr[0])}"
    name = f"{view}.png"
    try:
        truth = _image(store, photographs / name)
        baseline = _image(store, store.cell(pair["baseline_id"]).path / "renders" / name)
        ablation = _image(store, store.cell(pair["cell_id"]).path / "renders" / name)
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


def _training(store: Store, pair: pd.Series, file: Path) -> Picture:
    title = f"{_title(pair)}: training"
    runs = []
    for name, key in ((BASELINE, "baseline_id"), (str(pair["label"]), "cell_id")):
        try:
            history = store.cell(pair[key]).history()[["step", *_CURVES]]
            runs.append((name, history.apply(pd.to_numeric)))
        except (OSError, ValueError, TypeError, KeyError):
            return Picture(title, None, f"cells/{pair[key]}/history.csv can't be read")
    with atomic_writer(file) as stream:
        stream.write(curves(title, runs, _CURVES))
    return Picture(title, file)


def _title(pair: pd.Series) -> str:
    parts = (pair["scene"], pair["label"], pair["condition"], f"seed {pair['seed']}")
    return ", ".join(str(part) for part in parts if part)


def _image(store: Store, path: Path) -> NDArray[np.float32]:
    inside = path.relative_to(store.path)
    home = (store.path / inside.parts[0]).resolve()
    try:
        if not path.resolve().is_relative_to(home):
            raise ImageError("a link leads out of the store")
        if math.prod(images.size(path)) > _MOST_PIXELS:
            raise ImageError("too large to be drawn")
        return images.read(path)
    except (OSError, ImageError) as error:
        # Named inside the store: the report is the same wherever the store lies.
        raise ReportError(f"{inside.as_posix()} can't be read") from error


def slug(text: str) -> str:
    """`text` as part of a file name on any system; different texts give different names."""
    plain = re.sub(r"[^A-Za-z0-9_.]+", "-", text).strip("-.")[:60]
    if text and plain == text:
        return text
    return f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:6]}".lstrip("-")
