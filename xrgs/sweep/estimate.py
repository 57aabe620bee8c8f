"""Estimates the training time of a cell: from the finished cells of the store, or from its size."""

from __future__ import annotations

import heapq
from collections import defaultdict
from statistics import fmean
from typing import TYPE_CHECKING, Any

from xrgs.capture.degrade import resolve_degradation
from xrgs.errors import StoreError
from xrgs.safeio.hashing import canonical_json

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from xrgs.config import Conf
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.store import Store

#: Number of finished cells that are read, the newest first; more would take long and help little.
_MAX_CELLS = 500
#: How many times longer the torch backend takes for a training step than the native one: rendering
#: and loss, forward and backward, of 10,000 to 100,000 Gaussians took 32 to 69 times as long.
TORCH_SLOWDOWN = 50.0
#: Seconds of a training step of the torch backend for each pixel of the mean view, with as many
#: Gaussians as training makes at that size. Measured: 1.0e-5 to 1.8e-5.
_TORCH_STEP_S = 1.5e-5


class RuntimeEstimator:
    """Training times per step of the store's finished cells, grouped by what cells have in common.

    The times are of training alone, on whatever machine a cell was trained.
    """

    def __init__(self, store: Store) -> None:
        """Read the newest cells of a store."""
        self._seconds_per_step: defaultdict[str, list[float]] = defaultdict(list)
        for cell in _newest(store):
            try:
                identity, summary = cell.identity(), cell.summary()
                seconds = summary["training_time_s"] / identity["train"]["steps"]
                groups = list(_groups(identity))
            except (StoreError, ArithmeticError, KeyError, TypeError, ValueError):
                continue
            for group in groups:
                self._seconds_per_step[group].append(seconds)

    @property
    def known(self) -> bool:
        """Whether the store has a finished cell to go by."""
        return bool(self._seconds_per_step)

    def seconds(self, identity: Mapping[str, Any]) -> float | None:
        """Return the expected training time of a cell.

        It is the mean over the most similar cells that exist: those that differ in seed and code
        only; else those that differ in the number of steps as well; else those of the same variant;
        else all. Cells of the other backend count only where this one has none, and by
        `TORCH_SLOWDOWN`. Times are taken to be proportional to the number of steps.

        Args:
            identity: The cell's identity.

        Returns:
            Seconds; None if there is no finished cell.
        """
        torch = identity["splat"]["backend"] == "torch"
        other = {"backend": "native" if torch else "torch"}
        ratio = TORCH_SLOWDOWN if torch else 1 / TORCH_SLOWDOWN
        of_other = {**identity, "splat": {**identity["splat"], **other}}
        for similar, factor in ((identity, 1.0), (of_other, ratio)):
            for group in _groups(similar):
                if group in self._seconds_per_step:
                    seconds = factor * fmean(self._seconds_per_step[group])
                    return seconds * float(identity["train"]["steps"])
        return None


def torch_seconds(conf: Conf) -> float | None:
    """Return roughly how long the torch backend trains a cell, from the size of its images alone.

    Args:
        conf: The cell's config.

    Returns:
        Seconds, within a factor of about two; None if the photographs' own size is not changed,
        which the config does not tell.
    """
    side, hr = conf.variant.long_side, conf.variant.hr_fraction
    if not side:
        return None
    lr_area = conf.variant.factor**-2 if resolve_degradation(conf.variant) == "downsample" else 1.0
    share = {"mixed": hr + (1 - hr) * lr_area, "lr_only": lr_area}.get(conf.train.views, 1.0)
    pixels = 0.75 * side**2 * share  # photographs of 4 to 3
    return _TORCH_STEP_S * pixels * conf.train.steps


def _groups(identity: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys of the groups that a cell belongs to, from the most to the least similar."""
    program = {key: identity[key] for key in ("splat", "components", "variant")}
    yield canonical_json(program | {"train": identity["train"]})
    yield canonical_json(program | {"views": identity["train"]["views"]})
    yield f"{identity['splat']['backend']} {identity['variant']}"
    yield str(identity["splat"]["backend"])


def _newest(store: Store) -> list[CellFolder]:
    try:
        cells = [(cell.folder.lstat().st_mtime, cell.id) for cell in store.cell_folders()]
    except (OSError, StoreError):
        return []
    return [store.cell(cell_id) for _, cell_id in heapq.nlargest(_MAX_CELLS, cells)]
