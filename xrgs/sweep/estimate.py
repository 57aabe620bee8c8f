"""Estimates the time, memory and disk of a cell from the nearest finished cell of the store.

The config of the nearest cell differs in the fewest keys; another variant, processor or backend
counts as several keys. Seconds, memory and disk are scaled by steps, pixels and the budget of
Gaussians; the memory of the photographs is computed. A store without finished cells gives no
estimate.
"""

from __future__ import annotations

import heapq
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import cache
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

from xrgs.capture import frozen
from xrgs.capture.folders import trimmed_folder
from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.provenance import processor, this_processor
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import KEPT_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from xrgs.config import Conf
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.store import Store

#: Number of finished cells that are read, the newest first; more would take long and help little.
_MAX_CELLS = 500
#: How many times longer the torch backend takes for a training step than the native one: rendering
#: and loss, forward and backward, of 10,000 to 100,000 Gaussians took 32 to 69 times as long.
TORCH_SLOWDOWN = 50.0
#: The most seconds that count as loading and scoring. A store that was copied has other dates.
_MAX_OVERHEAD_S = 600.0
#: Bytes of a pixel in 8 bits, and in float32.
_RGB_BYTES, _FLOAT_RGB_BYTES = 3, 12
#: Keys that count as this many differing ones, in the distance of two cells.
_OTHER_VARIANT, _OTHER_PROCESSOR, _OTHER_BACKEND = 3, 5, 100


class _Sizes(NamedTuple):
    """Sizes of the training views of a cell."""

    pixels: float
    """Mean over the training steps."""
    largest: int
    """Pixels of the largest training view, the unit of budgets of Gaussians."""
    held_bytes: int
    """What training holds of all photographs: 8 bits of them, and moments up to `KEPT_BYTES`."""


@dataclass(frozen=True)
class Cost:
    """The expected time, memory and disk of a cell."""

    seconds: float
    """Time from its start to its end: training, loading and scoring."""
    scoring_s: float
    """Seconds of the final scoring."""
    memory_bytes: float
    """Resident memory of its process where that is largest."""
    disk_bytes: float
    """Size of its files when it is done."""


@dataclass(frozen=True)
class _Finished:
    """A finished cell, as estimates read it."""

    settings: frozenset[tuple[str, str]]
    variant_id: str
    sizes: _Sizes
    steps: int
    threads: int
    backend: str
    processor: str
    gaussians: int
    training_s: float
    overhead_s: float
    memory_bytes: float
    disk_bytes: float


class CostEstimator:
    """Estimates the cost of cells from the finished cells of a store."""

    def __init__(self, store: Store) -> None:
        """Read the newest finished cells; a cell that can't be read is left out."""
        self._store = store
        self._finished: list[_Finished] = []
        for cell in _newest(store):
            try:
                self._finished.append(self._read(cell))
            except (XrgsError, OSError, ValueError):
                continue

    @property
    def known(self) -> int:
        """Number of finished cells that the estimates are taken from."""
        return len(self._finished)

    def _read(self, cell: CellFolder) -> _Finished:
        conf, status = cell.config(), cell.status()
        summary, made = cell.summary(), cell.provenance()
        variant_id = cell.identity().variant
        ended, started = cell.status_file.stat().st_mtime, datetime.fromisoformat(made.started)
        overhead = ended - started.timestamp() - summary.training_time_s
        files = {**status.files, **status.trimmed}
        return _Finished(
            settings=_settings(conf),
            variant_id=variant_id,
            sizes=_sizes(self._store.variants, variant_id, conf.train.views, conf.train.hr_share),
            steps=summary.steps,
            threads=made.threads,
            backend=made.backend,
            processor=processor(made),
            gaussians=summary.gaussians,
            training_s=summary.training_time_s,
            overhead_s=overhead if 0 < overhead < _MAX_OVERHEAD_S else 0.0,
            memory_bytes=summary.peak_rss_bytes or 0.0,
            disk_bytes=sum(entry.bytes for entry in files.values()),
        )

    def cost(self, conf: Conf, variant_id: str | None, threads: int) -> Cost | None:
        """Return the expected cost of a cell; None if the store has no finished cell.

        Args:
            conf: The cell's config.
            variant_id: The id of its variant; None while the variant is not built.
            threads: Number of threads that train it.
        """
        if not self._finished:
            return None
        backend = resolve_backend(conf.splat.backend)
        settings, here = _settings(conf), this_processor(backend)

        def distance(past: _Finished) -> int:
            return (
                len(settings ^ past.settings)
                + _OTHER_VARIANT * (past.variant_id != variant_id)
                + _OTHER_PROCESSOR * (past.processor != here)
                + _OTHER_BACKEND * (past.backend != backend)
            )

        past = min(self._finished, key=distance)
        sizes = past.sizes  # of a variant that is not built yet, the nearest known ones
        if variant_id is not None:
            with suppress(StoreError):
                train = conf.train
                sizes = _sizes(self._store.variants, variant_id, train.views, train.hr_share)
        return _scaled(past, conf, sizes, threads, backend)


def _scaled(past: _Finished, conf: Conf, sizes: _Sizes, threads: int, backend: str) -> Cost:
    """Scale the cost of a finished cell to a planned one."""
    pixels = sizes.pixels / past.sizes.pixels
    most = conf.splat.densify.budget * sizes.largest
    count = min(past.gaussians, most) if most else past.gaussians
    gaussians = count / max(1, past.gaussians)
    # About half of a step's time and memory goes with the pixels and half with the Gaussians.
    step = (pixels + gaussians) / 2
    if backend != past.backend:
        step *= TORCH_SLOWDOWN if backend == "torch" else 1 / TORCH_SLOWDOWN
    training = past.training_s * conf.train.steps / past.steps * step
    training *= max(1, past.threads) / max(1, threads)
    overhead = past.overhead_s * pixels
    seconds = training + overhead
    # A cell of an older version held more of its photographs; then this is too much.
    memory = (past.memory_bytes - past.sizes.held_bytes) * step + sizes.held_bytes
    return Cost(seconds, overhead, memory, past.disk_bytes * gaussians)


def _settings(conf: Conf) -> frozenset[tuple[str, str]]:
    groups = {name: asdict(getattr(conf, name)) for name in ("splat", "train", "components")}
    return frozenset(_flat(groups))


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield each of nested values with its key, as `splat.densify.every`."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif f"{prefix}{key}" not in {"train.steps", "splat.backend"}:
            yield f"{prefix}{key}", repr(value)


@cache
def _sizes(variants: Path, variant_id: str, views: str, hr_share: float) -> _Sizes:
    """Return the sizes of a cell's training views, from the list of a variant, trimmed or not.

    Raises:
        StoreError: The list can't be read.
    """
    folder = variants / variant_id
    if not folder.is_dir():
        folder = trimmed_folder(variants, variant_id)
    manifest = frozen.read_manifest(folder)
    tag = {"hr_only": "HR", "lr_only": "LR"}.get(views)
    splits = ("train", "original") if views == "all_hr" else ("train",)  # originals replace
    trained_views = {
        view.name: view
        for split in splits
        for view in manifest.views
        if view.split == split and tag in (None, view.tag)
    }
    if not trained_views:
        raise StoreError(f"{folder}: no training view for train.views={views}")
    pixels = {name: view.width * view.height for name, view in trained_views.items()}
    trained = sum(pixels.values())
    tested = sum(view.width * view.height for view in manifest.views if view.split == "test")
    moments = min(KEPT_BYTES, 2 * _FLOAT_RGB_BYTES * trained)  # mean and variance
    held = _RGB_BYTES * (trained + tested) + moments
    by_tag = {
        tag: [pixels[name] for name, view in trained_views.items() if view.tag == tag]
        for tag in ("HR", "LR")
    }
    mean = trained / len(pixels)
    if all(by_tag.values()) and len(by_tag["HR"]) < hr_share * len(pixels):
        mean = hr_share * fmean(by_tag["HR"]) + (1 - hr_share) * fmean(by_tag["LR"])
    return _Sizes(mean, max(pixels.values()), held)


def _newest(store: Store) -> list[CellFolder]:
    try:
        cells = [cell for cell in store.cell_folders() if cell.status_file.exists()]
        return heapq.nlargest(_MAX_CELLS, cells, key=lambda cell: cell.path.stat().st_mtime)
    except (OSError, StoreError):
        return []
