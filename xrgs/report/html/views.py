"""The test views of the page: photograph, renders and error maps, with their scores."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from xrgs.capture import images
from xrgs.capture.images import ImageError
from xrgs.errors import StoreError, UnreadableError
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.report.html.album import Album, error_map
from xrgs.report.html.content import finite, run_names, runs, shown, why
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd
    from PIL import Image

    from xrgs.report.compare import Comparison
    from xrgs.report.html.content import Content
    from xrgs.report.joined import JoinedStore

#: The largest image that is read.
_MAX_PIXELS = 1 << 24
#: Scores by cell and view.
_Scores = dict[tuple[str, str], dict[str, float | None]]
#: About how many more pixels error maps add to those of renders.
_WITH_ERROR_MAPS = 1.25


def add_views(
    content: Content,
    store: JoinedStore,
    comparison: Comparison,
    views: pd.DataFrame,
    max_bytes: int,
) -> None:
    """Add every scored view of every cell, with as many images as fit.

    The first replicates of all scenes come first. A view without images has its scores, and the
    notes say how many there are.

    Args:
        content: The content of the page, to which views, images and notes are added.
        store: The store with photographs and renders.
        comparison: The comparison of the cells.
        views: The table `Sweep.views`.
        max_bytes: The most bytes that the images may take; 0 for no images.
    """
    scores: _Scores = {
        (row["cell_id"], row["view"]): {name: finite(row[name]) for name in VIEW_METRICS}
        for row in views.to_dict("records")
    }
    names = {name: list(rows["view"]) for name, rows in views.groupby("cell_id")}
    wanted = [
        (cells, view)
        for cells in runs(comparison)
        for view in dict.fromkeys(v for name in cells["cell_id"] for v in names.get(name, ()))
    ]
    pixels = sum(_pixels(store, cells, view) for cells, view in wanted) if max_bytes else 0
    album = Album(max_bytes, int(pixels * _WITH_ERROR_MAPS))
    first, left_out = len(content.images), 0
    for cells, view in progress(wanted, "encoding views", "view"):
        entry = _entry(cells, view, scores)
        content.views.append(entry)
        if max_bytes:
            found = _read(content, store, cells, view, _title(entry))
            left_out += found is not None and not _add_images(entry, found, album, first)
    content.images += album.urls
    if left_out:
        content.notes.append(
            f"The images of {left_out} of {len(wanted)} test views are left out, for the page's"
            " size; their scores are here, and their renders are in the store."
        )


def _title(entry: dict[str, Any]) -> str:
    return ", ".join(filter(None, (entry[key] for key in ("scene", "condition", "view"))))


def _photograph(store: JoinedStore, cells: pd.DataFrame, view: str) -> Path:
    """Return the file of the photograph of a view that cells are scored on."""
    first = cells.iloc[0]
    split = "train" if first["validation"] > 0 else "test"
    return store.variant(first["variant_id"]) / "images" / split / f"{view}.png"


def _pixels(store: JoinedStore, cells: pd.DataFrame, view: str) -> int:
    """Return the number of pixels of a view's images, 0 where its photograph can't be read."""
    try:
        width, height = images.size(_photograph(store, cells, view))
    except (UnreadableError, ImageError):
        return 0
    return width * height * (1 + len(cells))


def _entry(cells: pd.DataFrame, view: str, scores: _Scores) -> dict[str, Any]:
    arms = [
        {"label": shown(label), "scores": scores.get((cell_id, view), dict.fromkeys(VIEW_METRICS))}
        for cell_id, label in zip(cells["cell_id"], cells["label"], strict=True)
    ]
    return run_names(cells.iloc[0]) | {"view": shown(view), "arms": arms}


def _read(
    content: Content, store: JoinedStore, cells: pd.DataFrame, view: str, title: str
) -> tuple[Image.Image, dict[int, Image.Image]] | None:
    """Read a view's photograph, and the renders of it by the place of their cell.

    What can't be read, or is not of the photograph's size, is left out and noted. Without a
    photograph there is nothing to show.
    """
    found: dict[int, Image.Image] = {}
    try:
        truth = images.read_png_pil(_photograph(store, cells, view), max_pixels=_MAX_PIXELS)
    except (UnreadableError, ImageError) as error:
        content.notes.append(f"{title}: no photograph, {why(error, store)}")
        return None
    for place, cell_id in enumerate(cells["cell_id"]):
        try:
            file = store.render(cell_id, view)
            found[place] = images.read_png_pil(file, truth.size, _MAX_PIXELS)
        except (StoreError, ImageError) as error:
            label = shown(cells["label"].iloc[place])
            content.notes.append(f"{title}: no render of {label}, {why(error, store)}")
    return truth, found


def _add_images(
    entry: dict[str, Any],
    found: tuple[Image.Image, dict[int, Image.Image]],
    album: Album,
    first: int,
) -> bool:
    """Add a view's images to its entry and to the album; return whether they fit."""
    photograph, renders = found
    errors = [error_map(photograph, render) for render in renders.values()]
    places = album.add([photograph, *renders.values(), *errors])
    if places is None:
        return False
    entry["photograph"], entry["size"] = first + places[0], list(photograph.size)
    at_render, at_error = iter(places[1:]), iter(places[1 + len(renders) :])
    for place in renders:
        arm = entry["arms"][place]
        arm["image"], arm["error"] = first + next(at_render), first + next(at_error)
    return True
