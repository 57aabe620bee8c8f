"""Estimates what a cell will take: its time, its memory and its disk.

The logarithm of each cost is a sum of effects: of every setting with its value, of all settings
together, of the variant, and of sizes, each with an exponent (pixels, steps, Gaussians and others).
The number of Gaussians of a cell that is planned is estimated in the same way, up to what its
settings allow. The effects are fitted to the store's finished cells by ridge regression, which is a
normal prior on each: so a setting or a variant that no cell had counts as average, a variant of
another size is scaled, and a store without cells gives the prior, for a common machine. For times
the processor has an effect too: a cell that is planned counts as one of this machine, also where a
launcher will run it on another.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.errors import StoreError
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.provenance import processor, this_processor
from xrgs.safeio.records import as_number, read_object
from xrgs.sweep import features

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from xrgs.config import Conf, TrainConf
    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.store import Store
    from xrgs.sweep.features import Features

#: Number of finished cells that are read, the newest first; more would take long and help little.
_MAX_CELLS = 500
#: The most names of effects of all these cells; a store of ours has some hundred.
_MAX_NAMES = 10_000
#: Largest logarithm of a cost: that of 10^26.
_MAX_LOG = 60.0
#: How many times longer the torch backend takes for a training step than the native one: rendering
#: and loss, forward and backward, of 10,000 to 100,000 Gaussians took 32 to 69 times as long.
TORCH_SLOWDOWN = 50.0
#: Seconds beyond which the time of a cell beside its training is none: a store that was copied has
#: other dates.
_MAX_OVERHEAD_S = 600.0
#: Resident memory of a process that has imported torch and trains nothing.
_PROCESS_BYTES = 4e8
#: Standard deviations of logarithms: of a cell around its estimate, and of the priors of effects.
#: Chosen, as the priors, for the cells of 12 variants of 4 scenes that were left out in turn.
_RESIDUAL, _LEVEL, _NAME, _TORCH = 0.15, 1.0, 0.2, 0.3
_EXPONENTS = {
    "pixels": 0.2,
    "steps": 0.1,
    "points": 0.15,
    "views": 0.15,
    "threads": 0.15,
    "scored": 0.15,
    "gaussians": 0.1,
}


@dataclass(frozen=True)
class Prior:
    """What one cost is taken for where no cell tells otherwise."""

    typical: float
    """The cost of the native backend where every size is its unit: a scene of LLFF at 504 px,
    3,000 steps, one thread."""
    exponents: Mapping[str, float] = field(default_factory=dict)
    """The power of each size that the cost is proportional to, before any cell is known."""
    torch: float = 1.0
    """The factor of the torch backend."""
    timed: bool = False
    """Whether it depends on the processor."""

    def names(self, cell: Features) -> frozenset[str]:
        """Return the names of the effects on this cost of a cell."""
        if not (self.timed and cell.processor):
            return cell.names
        return cell.names | {f"processor={cell.processor:.200}"}

    def log(self, cell: Features) -> float:
        """Return the logarithm of the cost of a cell."""
        sizes = sum(power * cell.sizes.get(name, 0.0) for name, power in self.exponents.items())
        return math.log(self.typical) + sizes + math.log(self.torch) * cell.torch


#: The costs, by their names in `CostEstimator._read`. Measured on two cores of an Intel Xeon.
_PRIORS = {
    "step_s": Prior(
        0.03,
        {"pixels": 0.5, "gaussians": 0.5, "steps": 0.1, "views": 0.3, "threads": -0.85},
        TORCH_SLOWDOWN,
        timed=True,
    ),
    "overhead_s": Prior(6.0, {"pixels": 0.3, "scored": 0.7}, timed=True),
    "memory_bytes": Prior(4e8, {"pixels": 0.4, "gaussians": 0.4, "steps": 0.1, "views": 0.15}),
    "disk_bytes": Prior(2.6e7, {"pixels": 0.05, "gaussians": 0.95}),
}
#: The number of Gaussians at the end.
_COUNT = Prior(1.2e5, {"pixels": 0.6, "steps": 0.2, "views": 0.15, "points": 0.0})
#: A cell that ended with more than this share of what its settings allow was limited by them.
_LIMITED = 0.95


@dataclass(frozen=True)
class Cost:
    """What a cell is expected to take."""

    training_s: float
    """Time of training."""
    seconds: float
    """Time from its start to its end: training, loading and scoring."""
    memory_bytes: float
    """Resident memory of its process where that is largest."""
    disk_bytes: float
    """Size of its files when it is done."""
    scoring_s: float
    """Those of its seconds that are neither training nor evaluations amid it."""


class _Regression:
    """The effects on one cost that were fitted to past cells."""

    def __init__(self, prior: Prior, past: Iterable[tuple[Features, float]]) -> None:
        known = [(cell, cost) for cell, cost in past if 0 < cost < math.inf]
        self._prior = prior
        # What all cells have is part of the level.
        named = [prior.names(cell) for cell, _ in known]
        shared = frozenset[str].intersection(*named) if named else frozenset[str]()
        names = frozenset[str]().union(*named) - shared
        self._column = {name: number for number, name in enumerate(sorted(names))}
        exponents = [_EXPONENTS[name] for name in prior.exponents]
        deviations = [_LEVEL, _TORCH, *exponents, *[_NAME] * len(names)]
        variances = np.array(deviations) ** 2
        X = np.array([self._row(cell) for cell, _ in known]).reshape(-1, len(variances))
        y = np.array([math.log(cost) - prior.log(cell) for cell, cost in known])
        # As many equations as cells: there may be more effects.
        covariance = (X * variances) @ X.T + _RESIDUAL**2 * np.eye(len(known))
        self._effects = variances * (X.T @ np.linalg.solve(covariance, y))

    def _row(self, cell: Features) -> NDArray[np.float64]:
        """Return how often each effect is in the cost of a cell."""
        sizes = [cell.sizes.get(name, 0.0) for name in self._prior.exponents]
        named = np.zeros(len(self._column))
        names = self._prior.names(cell) & self._column.keys()
        named[[self._column[name] for name in names]] = 1
        return np.array([1.0, cell.torch, *sizes, *named])

    def __call__(self, cell: Features) -> float:
        """Return the expected cost of a cell."""
        logarithm = self._prior.log(cell) + float(self._row(cell) @ self._effects)
        return math.exp(min(max(logarithm, -_MAX_LOG), _MAX_LOG))


class CostEstimator:
    """Estimates what cells will take from the finished cells of a store."""

    def __init__(self, store: Store) -> None:
        """Read the newest cells of a store."""
        self._store = store
        self._past: list[tuple[Features, dict[str, float]]] = []
        names = set[str]()
        for cell in _newest(store):
            try:
                what, costs = self._read(cell)
            except (StoreError, OSError, AttributeError, ArithmeticError, KeyError, TypeError,
                    ValueError):  # fmt: skip
                continue
            names |= what.names
            if len(names) > _MAX_NAMES:
                break
            self._past.append((what, costs))

    @property
    def known(self) -> int:
        """Number of finished cells that the estimates are learned from."""
        return len(self._past)

    def _read(self, cell: CellFolder) -> tuple[Features, dict[str, float]]:
        """Return the features and the costs of a finished cell."""
        identity, summary = cell.identity(), cell.summary()
        try:
            provenance, status = cell.provenance(), read_object(cell.status)
        except StoreError:  # of them only the overhead, the disk and the threads are known
            provenance, status = {}, {}
        count = as_number(summary["gaussians"])
        what = replace(
            features.of_identity(identity, provenance.get("threads"), self._store, count),
            processor=processor(provenance),
        )
        training_s = as_number(summary["training_time_s"])
        costs = {"gaussians": count, "step_s": training_s / identity["train"]["steps"]}
        costs["memory_bytes"] = as_number(summary.get("peak_rss_bytes")) - _PROCESS_BYTES
        if status:
            costs["disk_bytes"] = sum(as_number(e["bytes"]) for e in status["files"].values())
            started = datetime.fromisoformat(provenance["started"]).timestamp()
            overhead = cell.status.lstat().st_mtime - started - training_s
            if 0 < overhead < _MAX_OVERHEAD_S:
                costs["overhead_s"] = overhead
        return what, costs

    @cached_property
    def _count(self) -> _Regression:
        """The regression of the number of Gaussians, from the cells that no budget limited."""
        found = [(cell, costs["gaussians"]) for cell, costs in self._past]
        return _Regression(
            _COUNT,
            [(_planned(cell), count) for cell, count in found if count < _LIMITED * cell.most],
        )

    @cached_property
    def _regressions(self) -> dict[str, _Regression]:
        return {
            name: _Regression(
                prior, [(cell, costs[name]) for cell, costs in self._past if name in costs]
            )
            for name, prior in _PRIORS.items()
        }

    def cost(
        self, conf: Conf, variant_id: str | None, identity: Mapping[str, Any] | None, threads: int
    ) -> Cost | None:
        """Return what a cell is expected to take.

        Args:
            conf: The cell's config.
            variant_id: The id of its variant; None while that is not built.
            identity: Its identity, where that is known.
            threads: Number of threads that train it.

        Returns:
            The cost; None where the variant is not built and keeps the photographs' own size.
        """
        identity = identity or cell_identity(conf, variant_id or "")
        if variant_id is None:
            what = features.of_conf(conf, identity, threads)
        else:
            what = features.of_identity(identity, threads, self._store)
        if what is None:
            return None
        here = this_processor(identity["splat"]["backend"])
        return self._cost(replace(what, processor=here), conf.train)

    def _cost(self, what: Features, train: TrainConf) -> Cost:
        count = min(self._count(what), what.most)
        log_count = math.log(count / features.UNITS["gaussians"])
        what = replace(what, sizes={**what.sizes, "gaussians": log_count})
        expected = {name: regression(what) for name, regression in self._regressions.items()}
        training_s = expected["step_s"] * train.steps
        evaluations = features.evaluations(train.steps, train.evaluate_every)
        scored = what.sizes.get("scored", 0.0) - math.log(evaluations)
        once = replace(what, sizes={**what.sizes, "scored": scored})
        return Cost(
            training_s,
            training_s + expected["overhead_s"],
            expected["memory_bytes"] + _PROCESS_BYTES,
            expected["disk_bytes"],
            self._regressions["overhead_s"](once),
        )


def _planned(cell: Features) -> Features:
    """Return the features of a cell as they are before it is trained."""
    sizes = {name: size for name, size in cell.sizes.items() if name != "gaussians"}
    return replace(cell, sizes=sizes)


def _newest(store: Store) -> list[CellFolder]:
    try:
        cells = [(cell.folder.lstat().st_mtime, cell.id) for cell in store.cell_folders()]
    except (OSError, StoreError):
        return []
    return [store.cell(cell_id) for _, cell_id in heapq.nlargest(_MAX_CELLS, cells)]
