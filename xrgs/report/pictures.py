"""Decides which pictures a report has, and reads their images from the store."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from xrgs.errors import StoreError, UnreadableError
from xrgs.photos import images
from xrgs.photos.images import ImageError
from xrgs.report.collect import ReportError, ReportStore
from xrgs.report.compare import Comparison, is_ratio, run_name
from xrgs.report.curves import means_over_runs, means_over_scenes
from xrgs.report.figures import (
    MAX_ARMS,
    Panel,
    curves,
    dependence,
    differing_crop,
    quality_curves,
    side_by_side,
    trade_off,
)
from xrgs.report.markup import titled
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.cell_folder import HISTORY
from xrgs.store.trimming import check_images

_Drawing = Callable[[Path], "Picture"]  # draws into the file

#: The scores in figures over training time.
_QUALITY = ("psnr", "lpips")
_QUALITY_TITLE = "Quality during training: scenes thin, mean thick, level where {base} ends"
#: The metrics in figures over a setting.
_DEPENDENT = frozenset({"gaussians", "lpips", "ssim", "psnr"})
_SENSITIVITY_TITLE = (
    "Change from {base} over {key}: replicates as dots, scenes thin, mean thick, better is up"
)
_CURVES = {"gaussians": "Gaussians", "loss": "loss of the step's view, as each run weighs it"}
#: The most pixels of an image: a figure needs three in memory, at 12 bytes a pixel.
MAX_PIXELS = 1 << 24
#: The most pictures that are drawn unless they are named; each takes up to a second.
_MAX_PICTURES = 40
#: A setting needs at least this many values for a figure over it.
_MIN_SETTINGS = 3
#: The largest value of a setting on an axis, whose margins must be finite in float64, too.
_MAX_SETTING = 1e100
#: The most ablations in a figure of trade-offs, which lists their names.
_MAX_ABLATIONS = 200


@dataclass(frozen=True)
class Picture:
    """The file of a figure, or the reason why there is none."""

    title: str
    file: Path | None
    why: str = ""


def draw(
    store: ReportStore,
    comparison: Comparison,
    views: pd.DataFrame,
    quality: pd.DataFrame,
    folder: Path,
    names: Sequence[str] | None = None,
) -> list[Picture]:
    """Draw the pictures of a report, in the order of the tables.

    For each condition: the trade-offs of its ablations if there are several, and quality during
    training if it was evaluated. For each setting with at least three values: the changes over it.
    For each scene and ablation: views and training curves of the first condition and replicate.
    `names` are their files without suffix; None draws the first 40. ReportError says that there is
    no picture of such a name.
    """
    first = comparison.pairs.sort_values(["variant_seed", "seed"], kind="stable")
    pairs = first.drop_duplicates(["scene", "label"]).sort_values(["scene", "label"])
    shown = {*pairs["cell_id"], *pairs["base_id"]}
    scores = views[views["cell_id"].isin(shown)].groupby("cell_id")
    psnr = {cell_id: rows.set_index("view")["psnr"] for cell_id, rows in scores}
    cells = comparison.cells.drop_duplicates("cell_id").set_index("cell_id")
    drawings = _curves_of_quality(comparison, quality)
    drawings |= _trade_offs(comparison) | _sensitivities(comparison)
    none = pd.Series(dtype=float)
    for _, pair in pairs.iterrows():
        base, ablation = psnr.get(pair["base_id"], none), psnr.get(pair["cell_id"], none)
        shared = ablation.index[ablation.index.isin(base.index)]
        both = base[shared], ablation[shared]
        cell = cells.loc[pair["cell_id"]]
        split = "train" if cell["validation"] > 0 else "test"
        variant = store.variant(cell["variant_id"])
        stem = f"{for_file_name(pair['scene'])}--{for_file_name(pair['label'])}"
        drawings[stem] = partial(_views, store, pair, comparison.base, both, variant, split)
        if not store.external.keys() & {pair["base_id"], pair["cell_id"]}:
            drawings[f"{stem}--training"] = partial(_training, store, pair, comparison.base)
    if unknown := [name for name in names or () if name not in drawings]:
        choices = ", ".join(drawings) or "none"
        raise ReportError(
            f"pictures={unknown[0]}: there is no picture of that name; choose from: {choices}"
        )
    chosen = {name: drawing for name, drawing in drawings.items() if name in (names or ())}
    if names is None:
        chosen = dict(islice(drawings.items(), _MAX_PICTURES))
    bar = progress(chosen.items(), "drawing", "picture", len(chosen))
    drawn = [drawing(folder / f"{name}.png") for name, drawing in bar]
    if names is None and len(chosen) < len(drawings):
        why = f"only the first {len(chosen)} are drawn; --pictures NAMES draws others"
        drawn.append(Picture(f"{len(drawings) - len(chosen)} more", None, why))
    return drawn


def _trade_offs(comparison: Comparison) -> dict[str, _Drawing]:
    """Return the trade-off figures, one for each condition with several ablations."""
    drawings: dict[str, _Drawing] = {}
    for condition in dict.fromkeys(condition for _, condition in comparison.groups):
        scenes = _absolute(comparison, condition)
        axes = [m for m in comparison.metrics if m.score is not None and m.name in scenes]
        numbers = scenes.drop(columns="scene").groupby(level=0, sort=False)
        means = numbers.mean().assign(scenes=numbers.size())
        if not 3 <= len(means) <= _MAX_ABLATIONS or not axes:
            continue
        title = titled("Quality against Gaussians, mean over scenes", condition)
        name = _file_name("trade-off", condition)
        drawings[name] = partial(_drawn, title, partial(trade_off, title, means, scenes, axes))
    return drawings


def _sensitivities(comparison: Comparison) -> dict[str, _Drawing]:
    """Return the figures of changes over each swept setting.

    All curves of a setting share a figure, unless there are `MAX_ARMS` or more: then each ablation
    has its own.
    """
    drawings: dict[str, _Drawing] = {}
    for key, changes in sensitivities(comparison).items():
        names = set(changes.dropna(subset="change")["metric"])
        axes = [metric for metric in comparison.metrics if metric.name in names & _DEPENDENT]
        if not axes:
            continue
        parts = {"": changes}
        if changes["series"].nunique() >= MAX_ARMS:
            parts = {str(name): rows for name, rows in changes.groupby("ablation", sort=False)}
        for ablation, rows in parts.items():
            title = titled(_SENSITIVITY_TITLE.format(base=comparison.base, key=key), ablation)
            name = _file_name(f"sensitivity-{for_file_name(key)}", ablation)
            drawings[name] = partial(_drawn, title, partial(dependence, title, key, rows, axes))
            if (count := rows["series"].nunique()) >= MAX_ARMS:
                why = f"{count} curves, and a figure can tell {MAX_ARMS - 1} apart"
                drawings[name] = partial(_not_drawn, title, why)
    return drawings


def sensitivities(comparison: Comparison) -> dict[str, pd.DataFrame]:
    """Return how the changes depend on each numeric setting with at least three values, by its key.

    The values are read from labels, for a setting of the ablation (`consistency.weight=0.05`), and
    from conditions, for a setting that the base has too (`variant.factor=2`). A table has a row for
    each change: `level` (`pair`, `scene` or `mean`), `scene` (missing for a mean), `metric`,
    `change`, `value` (of the setting), `ablation` (the label without the setting) and `series`
    (label and condition without the setting; each series is a curve).
    """
    changes = _changes(comparison)
    by_key = {}
    for key, places in _settings(comparison.groups).items():
        rows = changes.merge(places, on=["label", "condition"])
        values = rows.groupby("series")["value"].transform("nunique")
        if (values >= _MIN_SETTINGS).any():
            by_key[key] = rows[values >= _MIN_SETTINGS].sort_values("value", kind="stable")
    return by_key


def _changes(comparison: Comparison) -> pd.DataFrame:
    """Return the changes of pairs, of scenes and of the means in one table, in dB or %."""
    pairs = comparison.pairs
    ratios = {metric.name for metric in comparison.metrics if is_ratio(metric)}
    shown = np.where(pairs["metric"].isin(ratios), 100 * np.expm1(pairs["effect"]), pairs["effect"])
    levels = {
        "pair": pairs.assign(change=shown),
        "scene": comparison.per_scene.reset_index(),
        "mean": comparison.means.reset_index().assign(scene=None),
    }
    columns = ["label", "condition", "scene", "metric", "change"]
    tables = [table[columns].assign(level=level) for level, table in levels.items()]
    return pd.concat(tables, ignore_index=True)


def _settings(groups: Iterable[tuple[str, str]]) -> dict[str, pd.DataFrame]:
    """Return the `value`, `ablation` and `series` of `sensitivities` for each numeric setting.

    There is a row for each label and condition with the setting.
    """
    by_key: dict[str, list[tuple[str, str, float, str, str]]] = {}
    for label, condition in groups:
        words = f"{label} {condition}".strip().split(" ")
        label_words = label.count(" ") + 1
        for at, word in enumerate(words):
            key, _, text = word.partition("=")
            if abs(value := _number(text)) <= _MAX_SETTING:
                rest = words[:at] + words[at + 1 :]
                ablation = rest[: label_words - (at < label_words)]
                row = (label, condition, value, " ".join(ablation), " ".join(rest))
                by_key.setdefault(key, []).append(row)
    columns = ["label", "condition", "value", "ablation", "series"]
    return {key: pd.DataFrame(rows, columns=columns) for key, rows in by_key.items()}


def _number(text: str) -> float:
    """Convert a text to a number; NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _absolute(comparison: Comparison, condition: str) -> pd.DataFrame:
    """Return the mean Gaussians and scores of each label and scene.

    The index is the label, and the base comes first. Cells that lack a score or a finished base are
    left out; the tables say why.
    """
    cells = comparison.cells
    chosen = cells[(cells["condition"] == condition) & (cells["reason"] == "")]
    names = ["gaussians", *(m.name for m in comparison.metrics if m.score is not None)]
    means = chosen.groupby(["label", "scene"], sort=False)[names].mean()
    measured = means.dropna(axis="columns", how="all").dropna().reset_index()
    with_base = measured.loc[measured["label"] == comparison.base, "scene"]
    rows = measured[measured["scene"].isin(with_base)]
    return _base_first(rows, comparison.base).set_index("label")


def _base_first(rows: pd.DataFrame, base: str) -> pd.DataFrame:
    return rows.sort_values("label", key=lambda labels: labels != base, kind="stable")


def _curves_of_quality(comparison: Comparison, curves: pd.DataFrame) -> dict[str, _Drawing]:
    """Return figures of the quality during training, each with the base and seven ablations."""
    metrics = {metric.name: metric for metric in comparison.metrics}
    drawings: dict[str, _Drawing] = {}
    for condition in dict.fromkeys(curves["condition"]):
        rows = _base_first(means_over_runs(curves, condition), comparison.base)
        axes = [metrics[name] for name in _QUALITY if rows[name].notna().any()]
        first, *ablations = dict.fromkeys(rows["label"])
        if first != comparison.base or not axes:
            continue
        for at in range(0, len(ablations), MAX_ARMS - 1):
            shown = (comparison.base, *ablations[at : at + MAX_ARMS - 1])
            scenes = rows[rows["label"].isin(shown)]
            means = means_over_scenes(scenes)
            title = titled(_QUALITY_TITLE.format(base=comparison.base), condition)
            name = _file_name("time-to-quality", condition)
            name += f"-{at // (MAX_ARMS - 1) + 1}" * (at > 0)
            drawings[name] = partial(
                _drawn, title, partial(quality_curves, title, scenes, means, axes)
            )
    return drawings


def _file_name(kind: str, condition: str) -> str:
    return f"{kind}.{for_file_name(condition)}" if condition else kind


def _drawn(title: str, figure: Callable[[], bytes], file: Path) -> Picture:
    with atomic_writer(file) as stream:
        stream.write(figure())
    return Picture(title, file)


def _not_drawn(title: str, why: str, _: Path) -> Picture:
    return Picture(title, None, why)


def median_view(base: pd.Series, ablation: pd.Series) -> str:
    """Return the view with the median change of PSNR: neither the best nor the worst case.

    Both have the PSNR of each view, dB. Of an even number of views it is the lower in the middle.
    """
    change = (ablation - base.reindex(ablation.index)).fillna(0.0).sort_index()
    return str(change.sort_values(kind="stable").index[(len(change) - 1) // 2])


def _views(
    store: ReportStore,
    pair: pd.Series,
    base: str,
    psnr: tuple[pd.Series, pd.Series],
    variant: Path,
    split: str,
    file: Path,
) -> Picture:
    if psnr[0].empty:
        return Picture(run_name(pair), None, "the two cells have no scored view in common")
    view = median_view(*psnr)
    title = f"{run_name(pair)}: view {view}, by change of PSNR the median of {len(psnr[0])}"
    name = f"{view}.png"
    try:
        check_images(variant.parent, variant.name)
        truth = _image(store, variant / "images" / split / name)
        before = _image(store, store.render(pair["base_id"], view))
        ablation = _image(store, store.render(pair["cell_id"], view))
    except (ReportError, StoreError) as error:
        return Picture(title, None, str(error))
    panels = (
        Panel(truth, "photograph", f"{truth.shape[1]} × {truth.shape[0]} px"),
        Panel(before, base, f"PSNR {psnr[0][view]:.2f} dB"),
        Panel(ablation, str(pair["label"]), f"PSNR {psnr[1][view]:.2f} dB"),
    )
    if len({panel.image.shape for panel in panels}) > 1:
        return Picture(title, None, f"{view}: photograph and renders differ in size")
    note = f"where {base} and {pair['label']} differ most"
    crop = differing_crop(before, ablation)
    return _drawn(title, partial(side_by_side, title, panels, crop, note), file)


def _training(store: ReportStore, pair: pd.Series, base: str, file: Path) -> Picture:
    title = f"{run_name(pair)}: training"
    runs = []
    for name, key in ((base, "base_id"), (str(pair["label"]), "cell_id")):
        try:
            runs.append((name, store.cell(pair[key]).history()[["step", *_CURVES]]))
        except (StoreError, KeyError):
            return Picture(title, None, f"cells/{pair[key]}/{HISTORY} can't be read")
    return _drawn(title, partial(curves, title, runs, _CURVES), file)


def _image(store: ReportStore, file: Path) -> NDArray[np.float32]:
    try:
        return images.read_png(file, max_pixels=MAX_PIXELS)
    except (UnreadableError, ImageError) as error:
        raise ReportError(f"{store.without_paths(str(file))} can't be read") from error
