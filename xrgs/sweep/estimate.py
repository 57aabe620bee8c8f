"""Estimates the time, memory and disk of a cell from the nearest finished cells of the store.

The config of the nearest cells differs in the fewest keys; another variant, processor or backend
counts as several keys. The time of a step is taken to be proportional to

    rendered pixels + Gaussians,

with means over the steps. The pixels follow from the views of the variant and the components that
change the size of a render (`_rendered`). The Gaussians are those of the nearest cell, within the
budgets of the planned one. Of several equally near cells the median counts. A store without
finished cells gives no estimate.

In least squares of 111 cells of 2,000 steps at 500 px on one thread of an AMD EPYC (November 2026),
a rendered pixel took 290 ns and a Gaussian 344 ns: so both count alike.
"""

from __future__ import annotations

import heapq
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from datetime import datetime
from functools import cache
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import saved_variant
from xrgs.mixture.degradations import resolve_degradation
from xrgs.mixture.paths import trimmed_folder
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import KEPT_BYTES, NOMINAL_STEPS
from xrgs.store.provenance import processor, this_processor

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from xrgs.config import Conf
    from xrgs.mixture.saved_variant import ViewEntry
    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.store import Store

#: Gaussians of a cell for each pixel of its largest view, mean over the steps, where no finished
#: cell tells.
GAUSSIANS_OF_A_PIXEL = 0.5
#: Number of finished cells that are read, the newest first; more would take long and help little.
_MAX_CELLS = 500
#: How many times longer the torch backend takes for a training step than the native one: rendering
#: and loss, forward and backward, of 10,000 to 100,000 Gaussians took 32 to 69 times as long.
TORCH_SLOWDOWN = 50.0
#: The most seconds that count as loading and scoring. A store that was copied has other dates.
_MAX_OVERHEAD_S = 600.0
#: A photograph at 1/k of its size keeps about k to the minus this of its spectrum. With two thirds
#: the pixels that 140 cells with `resolution_schedule` rendered are estimated to within 12 %
#: (November 2026).
_SPECTRUM_DECAY = 2 / 3
#: `resolution_schedule` reduces photographs by no more than this.
_MOST_REDUCED = 8
#: Number of steps, evenly spaced, at which the schedules of components are looked at.
_SAMPLES = 30
#: Bytes of a pixel in 8 bits, and in float32.
_RGB_BYTES, _FLOAT_RGB_BYTES = 3, 12
#: Keys that count as this many differing ones, in the distance of two cells.
_OTHER_VARIANT, _OTHER_PROCESSOR, _OTHER_BACKEND = 3, 5, 100


class _Sizes(NamedTuple):
    """Sizes of the training views of a cell."""

    pixels: float
    """Pixels that a step renders, mean over the steps."""
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

    def left_s(self, trained: float) -> float:
        """Return the seconds to the end of a cell, with this share of its training done."""
        return (1 - trained) * (self.seconds - self.scoring_s) + self.scoring_s


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
    mean_gaussians: float
    """Mean over the steps."""
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
        variant_id, steps = cell.identity().variant, summary.steps
        ended, started = cell.status_file.stat().st_mtime, datetime.fromisoformat(made.started)
        overhead = ended - started.timestamp() - summary.training_time_s
        files = {**status.files, **status.trimmed}
        return _Finished(
            settings=_settings(conf),
            variant_id=variant_id,
            sizes=_sizes(self._store.variants, variant_id, conf),
            steps=steps,
            threads=made.threads,
            backend=made.backend,
            processor=processor(made),
            gaussians=summary.gaussians,
            mean_gaussians=summary.work.get("gaussians", summary.gaussians * steps) / steps,
            training_s=summary.training_time_s,
            overhead_s=overhead if 0 < overhead < _MAX_OVERHEAD_S else 0.0,
            memory_bytes=summary.peak_rss_bytes or 0.0,
            disk_bytes=sum(entry.bytes for entry in files.values()),
        )

    def cost(self, conf: Conf, variant_id: str | None, threads: int) -> Cost | None:
        """Return the expected cost of a cell; None if the store has no finished cell of its kind.

        Args:
            conf: The cell's config.
            variant_id: The id of its variant; None while the variant is not built.
            threads: Number of threads that train it.
        """
        backend = resolve_backend(conf.splat.backend)
        # Times of a GPU and of a processor say nothing about each other.
        on_gpu = backend == "gsplat"
        finished = [past for past in self._finished if (past.backend == "gsplat") == on_gpu]
        if not finished:
            return None
        settings, here = _settings(conf), this_processor(backend)

        def distance(past: _Finished) -> int:
            return (
                len(settings ^ past.settings)
                + _OTHER_VARIANT * (past.variant_id != variant_id)
                + _OTHER_PROCESSOR * (past.processor != here)
                + _OTHER_BACKEND * (past.backend != backend)
            )

        distances = [distance(past) for past in finished]
        least = min(distances)
        nearest = [p for p, far in zip(finished, distances, strict=True) if far == least]
        sizes = None
        if variant_id is not None:
            with suppress(StoreError):
                sizes = _sizes(self._store.variants, variant_id, conf)
        # Of a variant that is not built yet, the views of the cell's own variant are taken.
        costs = [_scaled(past, conf, sizes or past.sizes, threads, backend) for past in nearest]
        return Cost(*(median(values) for values in zip(*map(astuple, costs), strict=True)))


def _scaled(past: _Finished, conf: Conf, sizes: _Sizes, threads: int, backend: str) -> Cost:
    """Scale the cost of a finished cell to a planned one."""
    mean, last = _gaussians(past, conf, sizes.largest)
    step = (sizes.pixels + mean) / (past.sizes.pixels + past.mean_gaussians)
    if backend != past.backend:
        step *= TORCH_SLOWDOWN if backend == "torch" else 1 / TORCH_SLOWDOWN
    training = past.training_s * conf.train.steps / past.steps * step
    if backend != "gsplat":
        training *= max(1, past.threads) / max(1, threads)
    overhead = past.overhead_s * sizes.largest / past.sizes.largest
    seconds = training + overhead
    # A cell of an older version held more of its photographs; then this is too much.
    memory = (past.memory_bytes - past.sizes.held_bytes) * step + sizes.held_bytes
    return Cost(seconds, overhead, memory, past.disk_bytes * last / max(1, past.gaussians))


def _gaussians(past: _Finished, conf: Conf, largest: int) -> tuple[float, float]:
    """Return the Gaussians that a cell is expected to have: the mean over the steps, and the last.

    `splat.densify.budget` limits them from the beginning. `components.natural_selection` lets them
    grow first and then takes some away: the mean is half way between.
    """
    growth = _within(conf.splat.densify.budget * largest, past.gaussians)
    kept = min(growth, _within(conf.components.natural_selection.budget * largest, past.gaussians))
    return past.mean_gaussians * (growth + kept) / 2, past.gaussians * kept


def _within(budget: float, count: int) -> float:
    """Return which share of a count of Gaussians a budget leaves; a budget of 0 leaves all."""
    return min(1.0, budget / max(1, count)) if budget else 1.0


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
def read_views(variants: Path, variant_id: str) -> tuple[ViewEntry, ...]:
    """Return the list of a variant's views, trimmed or not.

    Raises:
        StoreError: The list can't be read.
    """
    folder = variants / variant_id
    if not folder.is_dir():
        folder = trimmed_folder(variants, variant_id)
    return saved_variant.read_manifest(folder).views


def _sizes(variants: Path, variant_id: str, conf: Conf) -> _Sizes:
    """Return the sizes of a cell's training views.

    Raises:
        StoreError: The variant's list of views can't be read, or has none that is trained on.
    """
    views = read_views(variants, variant_id)
    tag = {"hr_only": "HR", "lr_only": "LR"}.get(conf.train.views)
    # Originals take the place of degraded views.
    splits = ("train", "original") if conf.train.views == "all_hr" else ("train",)
    by_name = {
        view.name: view
        for split in splits
        for view in views
        if view.split == split and tag in (None, view.tag)
    }
    if not by_name:
        raise StoreError(f"variant {variant_id}: no view for train.views={conf.train.views}")
    training = tuple(by_name.values())
    pixels = [view.width * view.height for view in training]
    tested = sum(view.width * view.height for view in views if view.split == "test")
    moments = min(KEPT_BYTES, 2 * _FLOAT_RGB_BYTES * sum(pixels))  # mean and variance
    held = _RGB_BYTES * (sum(pixels) + tested) + moments
    return _Sizes(_rendered(training, conf), max(pixels), held)


def units_of_a_step(store: Store, conf: Conf, variant_id: str) -> float:
    """Return the rendered pixels and the Gaussians of a step of a cell, mean over the steps.

    Raises:
        StoreError: The variant's list of views can't be read.
    """
    sizes = _sizes(store.variants, variant_id, conf)
    return sizes.pixels + GAUSSIANS_OF_A_PIXEL * sizes.largest


def _rendered(views: Sequence[ViewEntry], conf: Conf) -> float:
    """Return the pixels that a step renders, mean over the steps."""
    hr, lr = ([view for view in views if view.tag == tag] for tag in ("HR", "LR"))
    # Validation holds some HR views out, and leaves two.
    trained_hr = max(min(2, len(hr)), len(hr) * (1 - conf.train.validation))
    share = trained_hr / (trained_hr + len(lr))
    if hr and lr:
        share = max(share, conf.train.hr_share)
    at_steps = [(n + 0.5) * NOMINAL_STEPS / _SAMPLES for n in range(_SAMPLES)]
    return sum(
        drawn * sum(_render_sizes(of_tag, conf, step)) / len(of_tag)
        for of_tag, drawn in ((hr, share), (lr, 1 - share))
        if of_tag
        for step in at_steps
    ) / len(at_steps)


def _render_sizes(views: Sequence[ViewEntry], conf: Conf, step: float) -> Iterator[float]:
    """Yield the pixels of the render of each view, as the components ask for at a nominal step."""
    larger, reduced = conf.components.supersampled, _reduced(conf, step)
    most = larger.late_factor if step >= larger.late_from else larger.factor
    blurred = conf.components.formation.widths != "none"
    zoom = conf.variant.factor if resolve_degradation(conf.variant) == "digital_zoom" else 1
    sizes = Counter(
        (v.width * v.height, min(max(1, round(v.supersampling)), most), v.tag) for v in views
    )
    for (pixels, factor, tag), count in sizes.items():
        scale = factor / reduced if tag == "HR" else float(factor)
        if tag == "LR" and (factor > 1 or blurred):  # at the size of the pixels that it resolves
            scale /= zoom
        yield count * pixels * scale**2


def _reduced(conf: Conf, step: float) -> int:
    """Return how many times smaller `resolution_schedule` makes HR views at a nominal step."""
    schedule = conf.components.resolution_schedule
    if not (0 < schedule.start_share < 1 <= schedule.until):  # off, or refused by the training
        return 1
    kept = schedule.start_share ** max(0.0, 1 - step / schedule.until)
    return min(_MOST_REDUCED, int(kept ** (-1 / _SPECTRUM_DECAY)))


def _newest(store: Store) -> list[CellFolder]:
    try:
        cells = [cell for cell in store.cell_folders() if cell.status_file.exists()]
        return heapq.nlargest(_MAX_CELLS, cells, key=lambda cell: cell.path.stat().st_mtime)
    except (OSError, StoreError):
        return []
