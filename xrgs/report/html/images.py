"""The pictures of the page: test views and training views as WebP, error maps, and models for 3D.

Images become data URLs, up to a total number of bytes.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from PIL import Image

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.mixture.views import Variant
from xrgs.photos import images
from xrgs.photos.images import ImageError
from xrgs.report.collect import ReportStore
from xrgs.report.html.content import Content, finite, run_names, shown, why
from xrgs.report.pictures import MAX_PIXELS
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from xrgs.viewer.trained import TrainedScene

#: The largest longer side of an image on the page, px.
_MAX_SIDE = 1008
#: The mean absolute difference of the channels, 0..1, at and above which an error map is brightest.
ERROR_RANGE = 0.25
#: Error maps are shrunk by this factor: they show where a render is wrong, not each pixel.
_ERROR_SHRINK = 2
#: Quality of WebP, and the most bytes that a pixel of a photograph takes with it; best first.
_QUALITIES = ((90, 0.40), (80, 0.22), (60, 0.13), (40, 0.09))

#: (cell's id, view) -> scores by name.
_Scores = dict[tuple[str, str], dict[str, float | None]]
#: The approximate ratio of all pixels, with error maps, to those of photographs and renders.
_WITH_ERROR_MAPS = 1.25


#: The most runs with training views and models.
_MAX_TRAINED = 12
#: The most Gaussians of a model, for weak graphics processors, and the fewest that show a scene.
_MAX_KEPT, _MIN_KEPT = 100_000, 8_000


class Album:
    """Adds images to those of a page (`urls`, as data URLs), each image once.

    All added data URLs have at most `max_bytes`. The expected number of added `pixels` decides the
    quality.
    """

    def __init__(self, urls: list[str], max_bytes: int, pixels: int) -> None:
        self._urls = urls
        self._left = max_bytes
        self._numbers: dict[str, int] = {}
        fitting = (quality for quality, size in _QUALITIES if pixels * size * 4 / 3 <= max_bytes)
        self._quality = next(fitting, _QUALITIES[-1][0])

    def add(self, images: Sequence[Image.Image]) -> list[int] | None:
        """Add RGB images that belong together; return the index of each in the page's images.

        If they do not fit, none is added, and the result is None.
        """
        urls = [data_url(image, self._quality) for image in images]
        new = dict.fromkeys(url for url in urls if url not in self._numbers)
        size = sum(map(len, new))
        if size > self._left:
            return None
        self._left -= size
        for url in new:
            self._numbers[url] = len(self._urls)
            self._urls.append(url)
        return [self._numbers[url] for url in urls]


def data_url(image: Image.Image, quality: int) -> str:
    """Encode an RGB image as WebP in a data URL; its longer side is shrunk to `_MAX_SIDE` at most.

    `quality` is on libwebp's scale, 1 to 100.
    """
    if max(image.size) > _MAX_SIDE:
        image = image.copy()
        image.thumbnail((_MAX_SIDE, _MAX_SIDE), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "WEBP", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}"


def error_map(photograph: Image.Image, render: Image.Image) -> Image.Image:
    """Draw the difference of a render from its photograph, RGB images of one size; else ValueError.

    It is the mean absolute difference of the channels, from black at 0 to pale yellow at
    `ERROR_RANGE` (matplotlib's magma), at half the size.
    """
    if photograph.size != render.size:
        raise ValueError("photograph and render differ in size")
    first, second = (np.asarray(image, dtype=np.float32) / 255 for image in (photograph, render))
    difference = np.abs(first - second).mean(axis=2) / ERROR_RANGE
    colored = colormaps["magma"](np.clip(difference, 0, 1), bytes=True)[..., :3]
    width, height = (max(1, side // _ERROR_SHRINK) for side in photograph.size)
    return Image.fromarray(np.ascontiguousarray(colored)).resize((width, height))


def add_views(
    content: Content,
    store: ReportStore,
    of_runs: Sequence[pd.DataFrame],
    views: pd.DataFrame,
    max_bytes: int,
) -> None:
    """Add all scored views of the cells of runs, with images until `max_bytes` are used.

    The first replicates of all scenes come first, each with its worst view first. From the first
    view on whose images do not fit, views have only their scores, and a note counts these views.
    """
    ids = {cell_id for cells in of_runs for cell_id in cells["cell_id"]}
    views = views[views["cell_id"].isin(ids)]
    scores: _Scores = {
        (row["cell_id"], row["view"]): {name: finite(row[name]) for name in VIEW_METRICS}
        for row in views.to_dict("records")
    }
    names = {str(name): list(rows["view"]) for name, rows in views.groupby("cell_id")}
    wanted = [
        (cells, view, entry) for cells in of_runs for view, entry in _entries(cells, names, scores)
    ]
    pixels = sum(_pixels(store, cells, view) for cells, view, _ in wanted) if max_bytes else 0
    album = Album(content.images, max_bytes, int(pixels * _WITH_ERROR_MAPS))
    left_out = 0
    for cells, view, entry in progress(wanted, "encoding views", "view"):
        content.views.append(entry)
        if left_out:  # reading and encoding take most of a large report's time
            left_out += 1
        elif max_bytes:
            title = ", ".join(filter(None, (entry[key] for key in ("scene", "condition", "view"))))
            pictures = _read(content, store, cells, view, title)
            left_out += pictures is not None and not _add_images(entry, pictures, album)
            if "size" in entry:
                entry["hidden"] = _hidden(_photograph(store, cells, view), tuple(entry["size"]))
    if left_out:
        content.notes.append(
            f"The images of {left_out} of {len(wanted)} test views are left out, for the page's"
            " size; their scores are here, and their renders are in the store."
        )


def _photograph(store: ReportStore, cells: pd.DataFrame, view: str) -> Path:
    """Return the file of a scored view's photograph; all cells of a run have one variant."""
    first = cells.iloc[0]
    split = "train" if first["validation"] > 0 else "test"
    return store.variant(first["variant_id"]) / "images" / split / f"{view}.png"


def _pixels(store: ReportStore, cells: pd.DataFrame, view: str) -> int:
    """Return the number of pixels of a view's images; 0 if its photograph can't be read."""
    try:
        width, height = images.size(_photograph(store, cells, view))
    except (UnreadableError, ImageError):
        return 0
    return width * height * (1 + len(cells))


def _hidden(photograph: Path, size: tuple[int, int]) -> float:
    """Return the share of a photograph's pixels that its mask hides; 0 if it has no mask."""
    file = photograph.parent.with_name(f"{photograph.parent.name}-masks") / photograph.name
    try:
        return float(1 - images.read_mask(file, size).mean())
    except (UnreadableError, ImageError):
        return 0.0


def _entries(
    cells: pd.DataFrame, names: dict[str, list[str]], scores: _Scores
) -> list[tuple[str, dict[str, Any]]]:
    """Return (view, its entry on the page) for the cells of a run, the lowest mean PSNR first."""
    entries = []
    for view in dict.fromkeys(v for name in cells["cell_id"] for v in names.get(name, ())):
        arms: list[dict[str, Any]] = [
            {"label": shown(label), "scores": scores.get((cell, view), dict.fromkeys(VIEW_METRICS))}
            for cell, label in zip(cells["cell_id"], cells["label"], strict=True)
        ]
        psnr = [arm["scores"]["psnr"] for arm in arms if arm["scores"]["psnr"] is not None]
        names_of = run_names(cells.iloc[0]) | {"view": shown(view)}
        entry = names_of | {"arms": arms, "psnr": finite(fmean(psnr)) if psnr else None}
        entries.append((view, entry))
    return sorted(entries, key=lambda one: math.inf if one[1]["psnr"] is None else one[1]["psnr"])


def _read(
    content: Content, store: ReportStore, cells: pd.DataFrame, view: str, title: str
) -> tuple[Image.Image, dict[int, Image.Image]] | None:
    """Read a view's photograph, and its renders by the index of their cell.

    A render that can't be read, or has another size than the photograph, is left out and noted. The
    result is None if the photograph can't be read.
    """
    renders: dict[int, Image.Image] = {}
    try:
        truth = images.read_png_pil(_photograph(store, cells, view), max_pixels=MAX_PIXELS)
    except (UnreadableError, ImageError) as error:
        content.notes.append(f"{title}: no photograph, {why(error, store)}")
        return None
    for place, cell_id in enumerate(cells["cell_id"]):
        try:
            file = store.render(cell_id, view)
            renders[place] = images.read_png_pil(file, truth.size, MAX_PIXELS)
        except (StoreError, ImageError) as error:
            label = shown(cells["label"].iloc[place])
            content.notes.append(f"{title}: no render of {label}, {why(error, store)}")
    return truth, renders


def _add_images(
    entry: dict[str, Any],
    pictures: tuple[Image.Image, dict[int, Image.Image]],
    album: Album,
) -> bool:
    """Add a view's images to its entry and to the album; return whether they fit."""
    photograph, renders = pictures
    errors = [error_map(photograph, render) for render in renders.values()]
    places = album.add([photograph, *renders.values(), *errors])
    if places is None:
        return False
    entry["photograph"], entry["size"] = places[0], list(photograph.size)
    at_render, at_error = iter(places[1:]), iter(places[1 + len(renders) :])
    for place in renders:
        arm = entry["arms"][place]
        arm["image"], arm["error"] = next(at_render), next(at_error)
    return True


def add_trained(
    content: Content,
    store: ReportStore,
    of_runs: Sequence[pd.DataFrame],
    variants: dict[str, Variant],
    max_image_bytes: int,
    max_model_bytes: int,
) -> None:
    """Add training views with their renders, models for 3D, and the cameras.

    They come from the first replicate of each scene and condition whose variant can be read.
    """
    first: dict[tuple[str, str], pd.DataFrame] = {}
    for rows in of_runs:
        first.setdefault((rows["scene"].iloc[0], rows["condition"].iloc[0]), rows)
    chosen = list(islice(first.values(), _MAX_TRAINED))
    if len(chosen) < len(first):
        content.notes.append(
            f"Training views and models are of {len(chosen)} of {len(first)} scenes and conditions."
        )
    readable = [rows for rows in chosen if rows["variant_id"].iloc[0] in variants]
    count = sum(map(len, readable))
    if not count:
        return
    from xrgs.viewer.trained import GAUSSIAN_BYTES, SHOWN_OF_A_TAG, TrainedScene

    fitting = int(max_model_bytes * 3 / 4 / GAUSSIAN_BYTES)  # Gaussians of all models
    kept = max(_MIN_KEPT, min(_MAX_KEPT, fitting // count))
    models_left = min(count, fitting // kept)
    shown_images = 2 * SHOWN_OF_A_TAG * (count + 2 * len(readable))
    sizes = [view.width * view.height for v in variants.values() for view in v.views]
    album = Album(content.images, max_image_bytes, shown_images * max(sizes))
    for rows in progress(readable, "rendering training views", "run"):
        names = run_names(rows.iloc[0])
        try:
            scene = TrainedScene(variants[rows["variant_id"].iloc[0]])
            cameras = [camera | {"name": shown(camera["name"])} for camera in scene.cameras()]
            content.cameras.append(names | {"cameras": cameras})
            labels = _load_models(content, store, rows, scene)
            _add_training_views(content, scene, names, labels, album)
            models = list(islice(scene.models(kept), models_left))
        except (XrgsError, ValueError) as error:  # what can't be rendered is a ValueError
            title = f"{names['scene']}: training views and models"
            content.notes.append(f"{title} are not shown, {why(error, store)}")
            continue
        models_left -= len(models)
        for cell_id, model in models:
            entry: dict[str, Any] = names | {"label": labels[cell_id]} | vars(model)
            entry["data"] = base64.b64encode(entry.pop("content")).decode("ascii")
            content.models.append(entry)
    if kept * count > fitting:
        left_out = count - fitting // kept
        content.notes.append(f"3D: {left_out} of {count} models are left out, for the page's size.")


def _load_models(
    content: Content, store: ReportStore, rows: pd.DataFrame, scene: TrainedScene
) -> dict[str, str]:
    """Load the Gaussians of the cells of a run; return {cell's id: label} for the readable ones."""
    labels: dict[str, str] = {}
    for cell_id, label in zip(rows["cell_id"], map(shown, rows["label"]), strict=True):
        if cell_id in store.external:
            continue
        try:
            scene.add(store.cell(cell_id))
            labels[cell_id] = label
        except XrgsError as error:
            title = f"{shown(rows['scene'].iloc[0])}, {label}"
            text = f"{title}: no training views and no model, {why(error, store)}"
            content.notes.append(text)
    return labels


def _add_training_views(
    content: Content,
    scene: TrainedScene,
    names: dict[str, str],
    labels: dict[str, str],
    album: Album,
) -> None:
    for view in scene.training_views():
        originals = [] if view.original is None else [view.original]
        shown_images = [view.photograph, *originals, *view.renders.values()]
        places = album.add([Image.fromarray(images.to_8_bit(image)) for image in shown_images])
        if places is None:
            content.notes.append(
                f"{names['scene']}: the training view {shown(view.name)} is left out, for the"
                " page's size."
            )
            continue
        content.training.append(
            names
            | {"view": shown(view.name), "tag": view.tag, "size": list(view.size)}
            | {"rendered": list(view.rendered), "photograph": places.pop(0)}
            | {"original": None if view.original is None else places.pop(0)}
            | {
                "arms": [
                    {"label": labels[cell_id], "image": place}
                    for cell_id, place in zip(view.renders, places, strict=True)
                ]
            }
        )
