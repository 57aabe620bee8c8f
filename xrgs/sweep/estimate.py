"""Estimates the time, memory and disk of a cell from the nearest finished cells of the store.

The config of the nearest cells differs in the fewest keys; another variant, processor or backend
counts as several keys. Time, memory and disk of such a cell are scaled by the pixels of a view, and
its time by the steps and threads too. The median of equally near cells is taken. A store without
finished cells gives no estimate.
"""

from __future__ import annotations

import heapq
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from statistics import fmean, median

from xrgs.composing import dotted
from xrgs.config import Conf
from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import saved_variant
from xrgs.mixture.saved_variant import ViewEntry
from xrgs.splat.backend import resolve_backend
from xrgs.store.cell_folder import CellFolder
from xrgs.store.provenance import processor, this_processor
from xrgs.store.store import Store
from xrgs.store.trimming import home_of

#: Assumed Gaussians of a cell for each pixel of its largest view, mean over the steps, while the
#: store has no finished cell. In least squares of 111 cells of 2,000 steps at 500 px on one thread
#: of an AMD EPYC (November 2026), a rendered pixel took 290 ns of a step and a Gaussian 344 ns:
#: both count alike.
GAUSSIANS_OF_A_PIXEL = 0.5
#: Number of finished cells that are read, the newest first; more would take long and help little.
_MAX_CELLS = 500
#: How many times longer the torch backend takes for a training step than the native one: rendering
#: and loss, forward and backward, of 10,000 to 100,000 Gaussians took 32 to 69 times as long.
TORCH_SLOWDOWN = 50.0
#: The most seconds that count as loading and scoring. A store that was copied has other dates.
_MAX_OVERHEAD_S = 600.0
#: Keys that count as this many differing ones, in the distance of two cells.
_OTHER_VARIANT, _OTHER_PROCESSOR, _OTHER_BACKEND = 3, 5, 100


@dataclass(frozen=True)
class Cost:
    """The expected time, memory and disk of a cell."""

    seconds: float
    """Time from its start to its end: training, loading and scoring."""
    scoring_s: float
    """Seconds of the final scoring."""
    memory_bytes: float
    """The most resident memory of its process."""
    disk_bytes: float

    def left_s(self, trained: float) -> float:
        """Return the seconds to the end of a cell of whose training this share is done."""
        return (1 - trained) * (self.seconds - self.scoring_s) + self.scoring_s


@dataclass(frozen=True)
class _Finished:
    """A finished cell, as estimates read it."""

    settings: frozenset[tuple[str, str]]
    variant_id: str
    pixels: float
    """Pixels of the training views, mean over the steps."""
    steps: int
    threads: int
    backend: str
    processor: str
    cost: Cost


class CostEstimator:
    """Estimates the cost of cells from the finished cells of a store."""

    def __init__(self, store: Store) -> None:
        """Read the newest finished cells; a cell that can't be read is left out."""
        self._store = store
        self._finished: list[_Finished] = []
        newest: list[CellFolder] = []
        with suppress(OSError, StoreError):
            cells = [cell for cell in store.cell_folders() if cell.status_file.exists()]
            newest = heapq.nlargest(_MAX_CELLS, cells, key=lambda cell: cell.path.stat().st_mtime)
        for cell in newest:
            with suppress(XrgsError, OSError, ValueError):
                self._finished.append(self._read(cell))

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
        overhead = overhead if 0 < overhead < _MAX_OVERHEAD_S else 0.0
        files = {**status.files, **status.trimmed}
        return _Finished(
            settings=_settings(conf),
            variant_id=variant_id,
            pixels=_pixels(self._store.variants, variant_id, conf)[0],
            steps=summary.steps,
            threads=made.threads,
            backend=made.backend,
            processor=processor(made),
            cost=Cost(
                summary.training_time_s + overhead,
                overhead,
                summary.peak_rss_bytes or 0.0,
                sum(entry.bytes for entry in files.values()),
            ),
        )

    def cost(self, conf: Conf, variant_id: str | None, threads: int) -> Cost | None:
        """Return the expected cost of a cell; None if the store has no finished cell of its kind.

        The variant has no id while it is not built.
        """
        backend = resolve_backend(conf.splat.backend)
        # Times of a GPU and of a processor say nothing about each other.
        on_gpu = backend == "gsplat"
        finished = [past for past in self._finished if (past.backend == "gsplat") == on_gpu]
        if not finished:
            return None
        settings, here = _settings(conf), this_processor(backend)
        by_distance: dict[int, list[_Finished]] = {}
        for past in finished:
            distance = len(settings ^ past.settings)
            distance += _OTHER_VARIANT * (past.variant_id != variant_id)
            distance += _OTHER_PROCESSOR * (past.processor != here)
            distance += _OTHER_BACKEND * (past.backend != backend)
            by_distance.setdefault(distance, []).append(past)
        nearest = by_distance[min(by_distance)]
        pixels = None
        if variant_id is not None:
            with suppress(StoreError):
                pixels = _pixels(self._store.variants, variant_id, conf)[0]
        # While the variant is not built, the views of the finished cell's variant are taken.
        costs = [_scaled(past, conf, pixels or past.pixels, threads, backend) for past in nearest]
        return Cost(*(median(values) for values in zip(*map(astuple, costs), strict=True)))


def _scaled(past: _Finished, conf: Conf, pixels: float, threads: int, backend: str) -> Cost:
    """Scale the cost of a finished cell to a planned one."""
    ratio = pixels / past.pixels
    seconds, overhead, memory, disk = (ratio * value for value in astuple(past.cost))
    training = (seconds - overhead) * conf.train.steps / past.steps
    if backend != past.backend:
        training *= TORCH_SLOWDOWN if backend == "torch" else 1 / TORCH_SLOWDOWN
    if backend != "gsplat":
        training *= max(1, past.threads) / max(1, threads)
    return Cost(training + overhead, overhead, memory, disk)


def _settings(conf: Conf) -> frozenset[tuple[str, str]]:
    groups = {name: asdict(getattr(conf, name)) for name in ("splat", "train", "components")}
    ignored = {"train.steps", "splat.backend"}
    return frozenset((key, repr(value)) for key, value in dotted(groups) if key not in ignored)


@cache
def read_views(variants: Path, variant_id: str) -> tuple[ViewEntry, ...]:
    """Return the list of a variant's views, trimmed or not."""
    return saved_variant.read_manifest(home_of(variants, variant_id)).views


def _pixels(variants: Path, variant_id: str, conf: Conf) -> tuple[float, int]:
    """Return the pixels of a cell's render, mean over the steps, and of its largest view."""
    views = read_views(variants, variant_id)
    # Originals take the place of degraded views.
    splits = ("train", "original") if conf.train.views == "all_hr" else ("train",)
    tag = {"hr_only": "HR", "lr_only": "LR"}.get(conf.train.views)
    by_name = {
        view.name: view
        for split in splits
        for view in views
        if view.split == split and tag in (None, view.tag)
    }
    if not by_name:
        raise StoreError(f"variant {variant_id}: no view for train.views={conf.train.views}")
    most = conf.components.supersampled.factor
    hr, lr = (
        [
            view.width * view.height * min(max(1, round(view.supersampling)), most) ** 2
            for view in by_name.values()
            if view.tag == tag
        ]
        for tag in ("HR", "LR")
    )
    largest = max(view.width * view.height for view in by_name.values())
    share = len(hr) / len(by_name)
    if hr and lr:
        share = max(share, conf.train.hr_share)
    classes = ((hr, share), (lr, 1 - share))
    mean = sum(weight * fmean(pixels) for pixels, weight in classes if pixels)
    return mean, largest


def units_of_a_step(store: Store, conf: Conf, variant_id: str) -> float:
    """Return the pixels and the Gaussians of a step of a cell, mean over the steps."""
    mean, largest = _pixels(store.variants, variant_id, conf)
    return mean + GAUSSIANS_OF_A_PIXEL * largest
