"""The texture of each scene beside what each ablation changes there [xrgs, section 7.2].

The paper finds XR-GS better on textured scenes and the baseline better on simple ones, and does not
say how texture is measured. Here it is the mean over the scored photographs of the magnitude of
their gradient, which `xrgs.training.components.texture` defines.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from xrgs.capture import images
from xrgs.capture.images import ImageError
from xrgs.errors import StoreError, UnreadableError
from xrgs.experiment.trimming import check_images
from xrgs.report.compare import is_amount
from xrgs.report.context import context_of
from xrgs.report.inference import MIN_VALUES
from xrgs.report.render import titled
from xrgs.report.writing import ARROWS_NOTE, by_key, percent, signed
from xrgs.runtime.progress import progress
from xrgs.runtime.text import TextTable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from xrgs.report.compare import Comparison
    from xrgs.report.context import Context
    from xrgs.report.joined import JoinedStore

_PHOTOGRAPH = ["variant_id", "split", "view"]


def with_texture(store: JoinedStore, cells: pd.DataFrame, views: pd.DataFrame) -> pd.DataFrame:
    """Return the scores of views with the texture of each view's photograph.

    Args:
        store: The stores that have the variants.
        cells: `Sweep.cells`.
        views: `Sweep.views`.

    Returns:
        The views, with `texture` in intensity per px of the photograph; NaN where the photograph
        was removed on purpose or can't be read.
    """
    scored = cells.drop_duplicates("cell_id").set_index("cell_id")[["variant_id", "validation"]]
    rows = views.join(scored, on="cell_id")
    rows["split"] = np.where(rows["validation"] > 0, "train", "test")
    photographs = rows[_PHOTOGRAPH].drop_duplicates()
    bar = progress(photographs.to_numpy(), "reading photographs", "photograph", len(photographs))
    photographs["texture"] = [_texture_of(store, *photograph) for photograph in bar]
    found = rows.merge(photographs, on=_PHOTOGRAPH, how="left")["texture"]
    return views.assign(texture=found.to_numpy(np.float64))


def _texture_of(store: JoinedStore, variant_id: str, split: str, view: str) -> float:
    """Return the mean magnitude of the gradient of one photograph; NaN where there is none."""
    try:
        variant = store.variant(variant_id)
        check_images(variant.parent, variant.name)
        return texture(images.read_png(variant / "images" / split / f"{view}.png"))
    except (ImageError, StoreError, UnreadableError):
        return math.nan


def texture(image: NDArray[np.float32]) -> float:
    """Return the mean magnitude of an image's gradient, in intensity per px.

    It is the mean of `xrgs.training.components.texture.gradient_magnitude` without the last row and
    column, which repeat others there; a report is made without torch.

    Args:
        image: [H, W, 3] in 0..1.

    Returns:
        The mean over the pixels, at most sqrt(2); NaN of an image that is one pixel high or wide.
    """
    if min(image.shape[:2]) < 2:
        return math.nan
    inner = image[:-1, :-1].astype(np.float64)
    squared = (image[:-1, 1:] - inner) ** 2 + (image[1:, :-1] - inner) ** 2
    return float(np.sqrt(squared.mean(axis=2)).mean())


def texture_tables(
    comparison: Comparison, views: pd.DataFrame, contexts: Mapping[str, Context]
) -> list[TextTable]:
    """Return a table for each condition that has at least three scenes of known texture.

    Args:
        comparison: The pairs of cells.
        views: What `with_texture` returns.
        contexts: How the cells of each condition were trained and scored.

    Returns:
        Tables with a row for each ablation and score: the change in percent of each scene, from the
        least textured scene to the most textured one, and Spearman's rank correlation of texture
        and change.
    """
    keys = comparison.cells.drop_duplicates("cell_id")[["cell_id", "condition", "scene"]]
    rows = views[["cell_id", "view", "texture"]].merge(keys, on="cell_id")
    by_scene = rows.groupby(["condition", "scene"], sort=False)["texture"].mean().dropna()
    tables = []
    for condition in by_scene.index.unique("condition"):
        scenes = by_scene.loc[condition].sort_values(kind="stable")
        if len(scenes) >= MIN_VALUES:
            tables.append(_table(comparison, contexts, condition, scenes))
    return tables


def _table(
    comparison: Comparison, contexts: Mapping[str, Context], condition: str, scenes: pd.Series
) -> TextTable:
    """Return the table of a condition; `scenes` has its textures by scene, in rising order."""
    per_scene = by_key(comparison.per_scene)
    rows: list[tuple[str, ...]] = []
    metrics = [metric for metric in comparison.metrics if not is_amount(metric)]
    for label in [name for name, of in comparison.groups if of == condition]:
        for metric in metrics:
            found = [per_scene.get((label, condition, name, metric.name)) for name in scenes.index]
            values = [math.nan if row is None else row.change for row in found]
            changes = pd.Series(values, scenes.index)
            if changes.notna().any():
                texts = (percent(change, metric) for change in changes)
                rows.append((label, metric.label, *texts, _rank_correlation(scenes, changes)))
    heads = tuple(f"{scene} ({value:.4f})" for scene, value in scenes.items())
    return TextTable(
        title=titled(f"Change from {comparison.base} by the texture of the scene, %", condition),
        columns=("Ablation", "Metric", *heads, "rank correlation"),
        rows=tuple(rows),
        align="ll" + "r" * (len(scenes) + 1),
        notes=(
            "texture, in parentheses: mean magnitude of the gradient of the scored photographs,"
            " intensity per px; the least textured scene first",
            "rank correlation: Spearman's, of texture and change over the scenes; it describes"
            " these scenes, and so few are no test",
            ARROWS_NOTE,
        ),
        context=context_of(contexts, condition).of_scores,
    )


def _rank_correlation(textures: pd.Series, changes: pd.Series) -> str:
    """Write the rank correlation over the scenes that have a change; empty of too few or equal."""
    known = changes.notna()
    if known.sum() < MIN_VALUES or changes[known].nunique() < 2 or textures[known].nunique() < 2:
        return ""
    return signed(textures[known].rank().corr(changes[known].rank()))
