"""How long a cell will take, from those that a store holds. Of training alone, on any machine."""

from __future__ import annotations

import heapq
import os
from collections import defaultdict
from statistics import fmean
from typing import TYPE_CHECKING, Any

from xrgs.safeio.hashing import canonical
from xrgs.safeio.records import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from xrgs.experiment.store import CellFolder, Store

#: So many finished cells are read, the newest: more would tell little and take long.
_READ = 500


class RuntimeEstimator:
    """Training times of a store's finished cells, per step, by what they have in common."""

    def __init__(self, store: Store) -> None:
        self._times: defaultdict[str, list[float]] = defaultdict(list)
        for cell in _newest(store):
            try:
                identity, summary = cell.identity(), cell.summary()
                a_step = summary["training_time_s"] / identity["train"]["steps"]
                names = _likenesses(identity)
            except (StoreError, ArithmeticError, KeyError, TypeError, ValueError):
                continue
            for name in names:
                self._times[name].append(a_step)

    @property
    def known(self) -> bool:
        """Whether there is any finished cell to go by."""
        return bool(self._times)

    def seconds(self, identity: Mapping[str, Any]) -> float | None:
        """The mean of the cells that are most like this one; None where there is none at all.

        Like it are, the first that there are: the same but for seed and code; but for the number
        of steps too; any of the same variant; any. Times are taken to grow with the steps alone.
        """
        for name in _likenesses(identity):
            if name in self._times:
                return fmean(self._times[name]) * float(identity["train"]["steps"])
        return None


def _likenesses(identity: Mapping[str, Any]) -> Iterator[str]:
    """What cells may have in common with this one, from the most to the least."""
    program = {key: identity[key] for key in ("splat", "components", "variant")}
    yield canonical(program | {"train": identity["train"]})
    yield canonical(program | {"views": identity["train"]["views"]})
    yield str(identity["variant"])
    yield ""


def _newest(store: Store) -> list[CellFolder]:
    try:
        with os.scandir(store.cells) as entries:
            found = [entry for entry in entries if "." not in entry.name]  # none set aside
            ids = [(entry.stat().st_mtime, entry.name) for entry in found]
    except OSError:
        return []
    return [store.cell(name) for _, name in heapq.nlargest(_READ, ids)]
