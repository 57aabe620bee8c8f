"""Loads models for viewing: the Gaussians of a cell with its cameras, or of a file."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from xrgs.errors import StoreError, XrgsError
from xrgs.formats.files import READERS, load_gaussians
from xrgs.formats.saved import check_is_read
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.settings import RasterSettings
from xrgs.store.store import Store
from xrgs.viewer.paths import Poses

_log = logging.getLogger(__name__)

#: The most models shown side by side.
MAX_MODELS = 2
#: The longest name of a model, in characters.
_MAX_NAME = 60


@dataclass(frozen=True)
class PosedView:
    """A view that a cell was trained or scored on."""

    name: str
    kind: str
    """`HR` or `LR` for a training view, `test` for a scored view."""
    camera: Camera


@dataclass(frozen=True)
class Model:
    """Gaussians for viewing, with their cameras if these are known."""

    name: str
    """The shown name, one printable line."""
    gaussians: Gaussians
    settings: RasterSettings
    """The settings of rendering, as in training. For a file, the defaults, antialiased if the file
    says so."""
    views: tuple[PosedView, ...] = ()
    """The views, training views first; none for a file."""
    poses: Poses | None = None
    """The cameras of the views as arrays, for paths; None for a file."""
    variant: str = ""
    """The id of the variant: models of one variant share a world. Empty for a file."""


def load_models(words: Sequence[str], store: Store, antialiased: bool | None = None) -> list[Model]:
    """Load one model, or two of one world, each a cell as of `Store.find_cell` or a file.

    `antialiased` says whether to render antialiased; None renders each as it was trained. A warning
    names a model that was trained otherwise.

    Raises:
        XrgsError: There are no words or too many, a word names no finished cell, a file is damaged,
            or the cells are of different variants; the message names the word or the file.
    """
    if not 1 <= len(words) <= MAX_MODELS:
        raise XrgsError(f"give one cell or {MAX_MODELS}, each by its id or as a file")
    models = [_with(_load(word, store), antialiased) for word in words]
    variants = sorted({model.variant for model in models if model.variant})
    if len(variants) > 1:
        raise XrgsError(
            f"{' and '.join(words)} are of different variants ({', '.join(variants)}): each has a "
            "world of its own, so no camera shows the same in both"
        )
    return models


def reference(models: Sequence[Model]) -> Model | None:
    """Return the first model that has views; None if all are files."""
    return next((model for model in models if model.views), None)


def _with(model: Model, antialiased: bool | None) -> Model:
    if antialiased is None or antialiased == model.settings.antialiased:
        return model
    trained = "antialiased" if model.settings.antialiased else "not antialiased"
    if not model.views and not model.settings.antialiased:
        trained = "without a word about antialiasing"
    _log.warning(
        "%s is %s; it is rendered %s, as asked",
        *(model.name, trained, "antialiased" if antialiased else "without antialiasing"),
    )
    return replace(model, settings=replace(model.settings, antialiased=antialiased))


def _load(word: str, store: Store) -> Model:
    file = user_path(word)
    if file.suffix.lower() in READERS:
        gaussians, antialiased = load_gaussians(file)
        settings = RasterSettings(antialiased=antialiased)
        return Model(for_line(file.name, _MAX_NAME), gaussians, settings)
    try:
        cell = store.find_cell(word)
        cell.check_done(verify=False)
    except StoreError:
        check_is_read(file)
        raise
    data = cell.dataset()
    train = [PosedView(view.name, view.tag, view.camera) for view in data.train]
    test = [PosedView(view.name, "test", view.camera) for view in data.test]
    viewmats = [
        np.stack([view.camera.viewmat.double().numpy() for view in part]) for part in (train, test)
    ]
    poses = Poses(viewmats[0], viewmats[1], data.points.double().numpy())
    names = store.cell_names().get(cell.id)
    label = f"{names.label} {names.condition}".rstrip() if names else ""
    return Model(
        for_line(f"{label or 'cell'} {cell.id[:8]}", _MAX_NAME),
        cell.gaussians(),
        cell.config().splat.raster,
        (*train, *test),
        poses,
        cell.identity().variant,
    )
