"""The trained Gaussians of the page: training views beside their renders, and models for 3D.

Cells keep renders of the views that they are scored on alone, so the others are rendered here. This
module imports torch, and is imported only where a cell has Gaussians to show.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from xrgs.capture import dataset
from xrgs.errors import XrgsError
from xrgs.report.html.album import Album, to_image
from xrgs.report.html.content import LOG_SCALES, run_names, shown, why
from xrgs.runtime.progress import progress
from xrgs.splat.attribution import attribute_pixels
from xrgs.splat.backend import resolve_backend
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.sh import C0

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from numpy.typing import NDArray

    from xrgs.capture.dataset import Dataset, LoadedView
    from xrgs.capture.views import Variant
    from xrgs.report.html.content import Content
    from xrgs.report.joined import JoinedStore
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians
    from xrgs.splat.settings import RasterSettings

#: How many training views of each tag are shown of a run.
_SHOWN_OF_A_TAG = 2
#: How many training views decide which Gaussians show; more are no longer worth the time.
_MAX_DECIDING = 12
#: The most Gaussians of a model, which a weak graphics processor can still sort and draw, and the
#: fewest with which one can be recognised.
_MAX_KEPT, _MIN_KEPT = 100_000, 8_000
#: A Gaussian of a model: 3 coordinates of 16 bits, and 8 bits for each of 3 scales, 4 components of
#: the quaternion, 3 colours and the opacity.
_BYTES = 17


@dataclass(frozen=True)
class _Model:
    """The Gaussians of a cell, and how they become pixels."""

    label: str
    gaussians: ActivatedGaussians
    raster: RasterSettings
    backend: str

    @torch.no_grad()
    def render(self, camera: Camera) -> torch.Tensor:
        """Render a view [H, W, 3] with all bands, as evaluation does."""
        degree = self.raster.sh_degree
        return rasterize_parameters(
            *self.gaussians, camera, self.raster, sh_degree=degree, backend=self.backend
        ).image

    def weights(self, cameras: Sequence[Camera]) -> torch.Tensor:
        """Return the blending weight of each Gaussian [N], summed over the pixels of cameras."""
        total = torch.zeros_like(self.gaussians.opacities)
        for camera in cameras:
            ones = torch.ones(camera.height, camera.width)
            found = attribute_pixels(
                ones, self.gaussians, camera, self.raster, backend=self.backend
            )
            total += found.sums
        return total


def add_trained(
    content: Content,
    store: JoinedStore,
    cells: Sequence[pd.DataFrame],
    variants: dict[str, Variant],
    max_image_bytes: int,
    max_model_bytes: int,
) -> None:
    """Add training views with renders of them, models for 3D, and the cameras.

    Args:
        content: The content of the page, to which they and notes are added.
        store: The store with the cells.
        cells: The runs to show: rows of `Comparison.cells`, one for each label, the base first.
        variants: The variants of the runs that can be read, by their ids.
        max_image_bytes: The most bytes that the images may take.
        max_model_bytes: The most bytes that the models may take as base64.
    """
    readable = [rows for rows in cells if rows["variant_id"].iloc[0] in variants]
    count = sum(map(len, readable))
    if not count:
        return
    kept = min(_MAX_KEPT, int(max_model_bytes * 3 / 4 / _BYTES / count))
    fitting = count if kept >= _MIN_KEPT else int(max_model_bytes * 3 / 4 / _BYTES / _MIN_KEPT)
    adder = _Adder(content, store, max(kept, _MIN_KEPT), fitting)
    shown_views = 2 * _SHOWN_OF_A_TAG * (count + 2 * len(readable))
    sizes = [view.width * view.height for v in variants.values() for view in v.views]
    album = Album(max_image_bytes, shown_views * max(sizes, default=0))
    for rows in progress(readable, "rendering training views", "run"):
        try:
            adder.add_run(rows, variants[rows["variant_id"].iloc[0]], album)
        except (XrgsError, ValueError) as error:  # what can't be rendered is a ValueError
            title = f"{shown(rows['scene'].iloc[0])}: training views and models"
            content.notes.append(f"{title} are not shown, {why(error, store)}")
    content.images += album.urls
    if count > fitting:
        content.notes.append(
            f"3D: {count - fitting} of {count} models are left out, for the page's size."
        )


@dataclass
class _Adder:
    """Adds what is made of one run after another."""

    content: Content
    store: JoinedStore
    kept: int
    """The most Gaussians of a model."""
    models_left: int

    def add_run(self, rows: pd.DataFrame, variant: Variant, album: Album) -> None:
        """Add the training views and models of one scene, condition and replicate.

        Raises:
            XrgsError: The variant's images can't be read.
        """
        data = dataset.load(variant, "mixed")
        names = run_names(rows.iloc[0])
        self.content.cameras.append(names | {"cameras": [*_cameras(data)]})
        own = rows[~rows["cell_id"].isin(self.store.external)]
        models = [model for _, row in own.iterrows() if (model := self._load(row)) is not None]
        self._add_training(names, models, variant, data, album)
        for model in models[: self.models_left]:
            self.content.models.append(names | self._quantised(model, data.train))
        self.models_left = max(0, self.models_left - len(models))

    def _load(self, row: pd.Series) -> _Model | None:
        """Load the Gaussians of a cell; None, and a note, where they can't be read."""
        cell, label = self.store.cell(row["cell_id"]), shown(row["label"])
        try:
            raster, gaussians = cell.config().splat.raster, cell.gaussians()
        except (XrgsError, OSError) as error:
            self.content.notes.append(
                f"{shown(row['scene'])}, {label}: no training views and no model,"
                f" {why(error, self.store)}"
            )
            return None
        backend = resolve_backend("auto")
        with torch.no_grad():
            activated = gaussians.activated(backend=backend)
        if not all(bool(torch.isfinite(values).all()) for values in activated):
            self.content.notes.append(
                f"{shown(row['scene'])}, {label}: no training views and no model, its Gaussians"
                " have scales that are not finite"
            )
            return None
        return _Model(label, activated, raster, backend)

    def _add_training(
        self,
        names: dict[str, str],
        models: Sequence[_Model],
        variant: Variant,
        data: Dataset,
        album: Album,
    ) -> None:
        """Add some views of each tag beside renders, at the size before they were degraded."""
        originals = {view.name: view for view in _originals(variant)}
        for view in _evenly(data.train):
            original = originals.get(view.name) if view.tag == "LR" else None
            camera = (original or view).camera
            pictures = [view.image] + ([original.image] if original else [])
            pictures += [model.render(camera) for model in models]
            places = album.add([to_image(picture.numpy()) for picture in pictures])
            if places is None:
                self.content.notes.append(
                    f"{names['scene']}: the training view {shown(view.name)} is left out, for the"
                    " page's size."
                )
                continue
            numbers = [len(self.content.images) + place for place in places]
            entry: dict[str, Any] = names | {"view": shown(view.name), "tag": view.tag}
            entry |= {"photograph": numbers.pop(0), "size": [view.camera.width, view.camera.height]}
            entry["original"] = numbers.pop(0) if original else None
            entry["rendered"] = [camera.width, camera.height]
            labels = [model.label for model in models]
            pairs = zip(labels, numbers, strict=True)
            entry["arms"] = [{"label": label, "image": number} for label, number in pairs]
            self.content.training.append(entry)

    def _quantised(self, model: _Model, views: Sequence[LoadedView]) -> dict[str, Any]:
        """Return a model for the page: the Gaussians that show most in training views."""
        step = max(1, -(-len(views) // _MAX_DECIDING))
        weights = model.weights([view.camera for view in views[::step]])
        # Stable, so that equal weights keep the order of the file.
        order = torch.sort(weights, descending=True, stable=True).indices[: self.kept]
        kept, _ = order.sort()
        share = float(weights[kept].double().sum() / weights.double().sum().clamp(min=1e-12))
        return {
            "label": model.label,
            "count": len(kept),
            "total": len(weights),
            "share": round(share, 4),
            "eps2d": model.raster.eps2d,
            "antialiased": model.raster.antialiased,
            "data": base64.b64encode(quantise(model.gaussians, kept)).decode("ascii"),
        }


def quantise(gaussians: ActivatedGaussians, kept: torch.Tensor) -> bytes:
    """Quantise Gaussians for the page's viewer, which undoes it in `splats.js`.

    A coordinate x is kept as x / (1 + |x|), so that the centre of the normalised world has a
    resolution of 3e-5, and what is far away still has a place. Of the harmonics band 0 is kept.

    Args:
        gaussians: N Gaussians.
        kept: [M] which of them to take.

    Returns:
        M times three little-endian uint16 of the means; then M times 11 uint8: three scales (their
        logarithms over `LOG_SCALES`), the quaternion (-1..1), the colour, and the opacity.
    """
    means, quats, scales, opacities, sh0 = (
        value.detach()[kept].numpy().astype(np.float64) for value in gaussians[:5]
    )
    least, most = LOG_SCALES
    bounded = means / (1 + np.abs(means))
    logs = (np.log(np.maximum(scales, 1e-30)) - least) / (most - least)
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    colors = 0.5 + C0 * sh0[:, 0]
    rest = np.concatenate([logs, (unit + 1) / 2, colors, opacities[:, None]], axis=1)
    return _whole((bounded + 1) / 2, "<u2").tobytes() + _whole(rest, "u1").tobytes()


def _whole(values: NDArray[np.float64], kind: str) -> NDArray[np.unsignedinteger[Any]]:
    """Spread 0..1 over the whole numbers of an unsigned type."""
    most = np.iinfo(kind).max
    whole: NDArray[np.unsignedinteger[Any]] = np.round(np.clip(values, 0, 1) * most).astype(kind)
    return whole


def _originals(variant: Variant) -> tuple[LoadedView, ...]:
    """Return the training views before they were degraded; none where a camera took them so."""
    if not any(view.split == "original" for view in variant.views):
        return ()
    return dataset.load(variant, "all_hr").train


def _evenly(views: Sequence[LoadedView]) -> list[LoadedView]:
    """Return a few views of each tag, evenly spaced in their order, LR first as in the paper."""
    chosen = []
    for tag in ("LR", "HR"):
        of_tag = [view for view in views if view.tag == tag]
        count = min(_SHOWN_OF_A_TAG, len(of_tag))
        chosen += [of_tag[(2 * at + 1) * len(of_tag) // (2 * count)] for at in range(count)]
    return chosen


def _cameras(data: Dataset) -> list[dict[str, Any]]:
    """Return the cameras of a run: those of its training views, then of its test views."""
    views = [(view.tag, view) for view in data.train] + [("test", view) for view in data.test]
    return [
        {
            "name": shown(view.name),
            "kind": kind,
            "size": [view.camera.width, view.camera.height],
            "K": [float(view.camera.K[row, column]) for row, column in _INTRINSICS],
            "viewmat": [round(value, 6) for value in view.camera.viewmat[:3].flatten().tolist()],
        }
        for kind, view in views
    ]


#: Where fx, fy, cx and cy are in an intrinsic matrix.
_INTRINSICS = ((0, 0), (1, 1), (0, 2), (1, 2))
