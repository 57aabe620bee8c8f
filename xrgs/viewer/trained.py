"""Renders training views and quantises Gaussians for the page of a report.

Cells keep only renders of scored views, so training views are rendered here. Reports don't import
torch: they call this module only for pages with pictures, and get plain numbers, bytes and arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.mixture.views import Variant
from xrgs.splat.backend import resolve_backend
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
from xrgs.splat.rendering import attribute_pixels, rasterize
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import C0
from xrgs.store.cell_folder import CellFolder
from xrgs.training import dataset
from xrgs.training.dataset import Dataset, LoadedView

Image = NDArray[np.float32]  # [H, W, 3] 0..1

#: The number of shown training views of each tag.
SHOWN_OF_A_TAG = 2
LOG_SCALES = (-9.0, 3.0)
"""The range of the scales' natural logarithms that 8 bits cover, in the normalised world. A step is
5%, and smaller scales are far below a pixel."""
GAUSSIAN_BYTES = 17
"""Bytes of a quantised Gaussian: 3 coordinates of 16 bits, and 8 bits for each of 3 scales, 4
components of the quaternion, 3 colours and the opacity."""
#: The number of training views by which the shown Gaussians are chosen; more cost too much time.
_MAX_DECIDING = 12


@dataclass(frozen=True)
class TrainingView:
    """A training view with its renders by several cells."""

    name: str
    tag: str
    """`HR` or `LR`."""
    size: tuple[int, int]
    """Width and height of the photograph in training, px."""
    photograph: Image
    original: Image | None
    """The photograph before it was degraded; None if it was not."""
    rendered: tuple[int, int]
    """Width and height of the renders, px: the original's size, else the photograph's."""
    renders: dict[str, Image]
    """Id of a cell -> its render."""


@dataclass(frozen=True)
class PageModel:
    """The Gaussians of a cell with the largest blending weights in training views, quantised."""

    count: int
    """Number of kept Gaussians, of the cell's `total`."""
    total: int
    share: float
    """Their share of all blending weights in the training views, 0 to 1."""
    eps2d: float
    antialiased: bool
    content: bytes
    """The bytes of `quantise`."""
    log_scales: tuple[float, float] = LOG_SCALES


class TrainedScene:
    """Cells of one variant: its cameras, and the cells' renders and models."""

    def __init__(self, variant: Variant) -> None:
        """Load the photographs and cameras."""
        self._data = dataset.load(variant, "mixed")
        self._originals = _originals(variant)
        self._models: dict[str, _Model] = {}

    def add(self, cell: CellFolder) -> None:
        """Load the Gaussians of a cell; XrgsError if they can't be read, or are not finite."""
        try:
            raster, gaussians = cell.config().splat.raster, cell.gaussians()
        except OSError as error:
            raise XrgsError(f"{cell.path}: {error.strerror}") from error
        backend = resolve_backend("auto")
        with torch.no_grad():
            activated = gaussians.activated(backend=backend)
        if not all(bool(torch.isfinite(values).all()) for values in activated):
            raise XrgsError("its Gaussians have scales that are not finite")
        self._models[cell.id] = _Model(gaussians, activated, raster, backend)

    def cameras(self) -> list[dict[str, Any]]:
        """Return the cameras of the training views, then of the test views, as plain numbers.

        Returns:
            For each camera: `name`; `kind` (`HR`, `LR` or `test`); `size` (width and height, px);
            `K` (fx, fy, cx, cy, px); `viewmat` (the upper three rows, world to camera).
        """
        data = self._data
        views = [(view.name, view.tag, view.camera) for view in data.train]
        views += [(view.name, "test", view.camera) for view in data.test]
        return [
            {
                "name": name,
                "kind": kind,
                "size": [camera.width, camera.height],
                "K": [float(camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))],
                "viewmat": [round(value, 6) for value in camera.viewmat[:3].flatten().tolist()],
            }
            for name, kind, camera in views
        ]

    def training_views(self) -> Iterator[TrainingView]:
        """Yield some training views of each tag with the renders of all cells.

        LR views come first, as in the paper's figures. They are rendered at their size before
        degradation.
        """
        for view in _evenly(self._data):
            original = self._originals.get(view.name) if view.tag == "LR" else None
            camera = (original or view).camera
            yield TrainingView(
                view.name,
                view.tag,
                (view.camera.width, view.camera.height),
                view.image.numpy(),
                original.image.numpy() if original else None,
                (camera.width, camera.height),
                {cell_id: model.render(camera) for cell_id, model in self._models.items()},
            )

    def models(self, most: int) -> Iterator[tuple[str, PageModel]]:
        """Yield the id and the model of each cell, with at most `most` Gaussians."""
        views = self._data.train
        step = max(1, -(-len(views) // _MAX_DECIDING))
        cameras = [view.camera for view in views[::step]]
        for cell_id, model in self._models.items():
            yield cell_id, model.for_page(cameras, most)


@dataclass(frozen=True)
class _Model:
    """The Gaussians of a cell, and the settings of their rendering."""

    gaussians: Gaussians
    activated: ActivatedGaussians
    raster: RasterSettings
    backend: str

    @torch.no_grad()
    def render(self, camera: Camera) -> Image:
        """Render a view with all bands of the harmonics, as evaluation does."""
        render = rasterize(self.gaussians, camera, settings=self.raster, backend=self.backend)
        return np.asarray(render.image.numpy())

    def for_page(self, cameras: Sequence[Camera], most: int) -> PageModel:
        """Return the Gaussians with the largest blending weights, summed over cameras' pixels."""
        weights = torch.zeros_like(self.activated.opacities)
        for camera in cameras:
            ones = torch.ones(camera.height, camera.width)
            attribution = attribute_pixels(
                ones, self.activated, camera, self.raster, backend=self.backend
            )
            weights += attribution.sums
        # Stable, so that equal weights keep the order of the file.
        order = torch.sort(weights, descending=True, stable=True).indices[:most]
        kept, _ = order.sort()
        share = float(weights[kept].double().sum() / weights.double().sum().clamp(min=1e-12))
        return PageModel(
            count=len(kept),
            total=len(weights),
            share=round(share, 4),
            eps2d=self.raster.eps2d,
            antialiased=self.raster.antialiased,
            content=quantise(self.activated, kept),
        )


def quantise(gaussians: ActivatedGaussians, kept: torch.Tensor) -> bytes:
    """Quantise some of N Gaussians, by their indices [M], for the page's viewer (`splats.js`).

    A coordinate x is stored as x / (1 + |x|): the resolution is 3e-5 at the centre of the
    normalised world, and any distance fits. Only band 0 of the harmonics is kept. First come the
    means, M times three little-endian uint16. Then M times 11 uint8: three scales (their logarithms
    over `LOG_SCALES`), the quaternion (-1..1), the colour, the opacity.
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
    """Scale 0..1 to the whole range of an unsigned integer type."""
    most = np.iinfo(kind).max
    whole: NDArray[np.unsignedinteger[Any]] = np.round(np.clip(values, 0, 1) * most).astype(kind)
    return whole


def _originals(variant: Variant) -> Mapping[str, LoadedView]:
    """Return the training views before degradation, by name; {} if none is degraded."""
    if not any(view.split == "original" for view in variant.views):
        return {}
    return {view.name: view for view in dataset.load(variant, "all_hr").train}


def _evenly(data: Dataset) -> list[LoadedView]:
    """Return a few training views of each tag, evenly spaced in their order, LR first."""
    chosen = []
    for tag in ("LR", "HR"):
        of_tag = [view for view in data.train if view.tag == tag]
        count = min(SHOWN_OF_A_TAG, len(of_tag))
        chosen += [of_tag[(2 * at + 1) * len(of_tag) // (2 * count)] for at in range(count)]
    return chosen
