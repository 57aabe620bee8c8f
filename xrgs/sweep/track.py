"""Writes the curves of a sweep's cells to where people follow trainings, while the cells train.

A cell writes `history.csv` and `quality.csv` as it trains, wherever its launcher runs it. A thread
of the sweep reads these files as they grow. So tracking takes no time and no memory from a
training, and no cell can fail by it.
"""

from __future__ import annotations

import math
import threading
from contextlib import suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING, Self

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.photos import scenes
from xrgs.runtime.progress import log_line
from xrgs.safeio.records import as_number, read_table
from xrgs.store.listing import modified
from xrgs.sweep.trackers import SINKS, Curves, Run, mlflow_uri

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.store import Store
    from xrgs.sweep.plan import PlannedCell
    from xrgs.sweep.trackers import Sink

#: The folder of a store for tracking; each kind has a folder in it.
FOLDER = "tracking"
#: The values of `track`. A kind but the first two needs the package and the extra of its name.
KINDS = ("none", *SINKS)
#: Seconds between two looks at the cells, and from a failure to the next look.
_POLL_S, _PAUSE_S = 2.0, 30.0
#: Seconds that the end of a sweep waits for a tracker, for example for a server that is away.
_END_S = 60.0


def check(kind: str) -> None:
    """Check, before anything is trained, that cells can be tracked with this value of `track`."""
    if kind not in KINDS:
        raise XrgsError(f"track={kind}: must be one of {', '.join(KINDS)}")
    if kind not in KINDS[:2] and find_spec(kind) is None:
        raise XrgsError(f"track={kind}: it is not installed: pip install 'xrgs[{kind}]'")


def curves(cell: CellFolder, *, done: bool) -> Curves:
    """Read the curves that a cell has written so far.

    Unless the cell is done, they end with the last row of the history: scores of later steps may
    not be complete.

    Raises:
        StoreError: A file can't be read; the message names it.
        ValueError: A value is not a number.
    """
    history = _table(cell.path / "history.csv", "history")
    quality = cell.path / "quality.csv"
    rows = [*history, *(_table(quality, "quality") if quality.is_file() else ())]
    if done:
        from xrgs.store.results import cell_metrics  # pandas is slow to load

        summary = cell.summary()
        scores = cell_metrics(summary, cell.scores())
        rows.append((summary.steps, {f"score/{name}": score for name, score in scores.items()}))
    else:
        rows = [(step, values) for step, values in rows if step <= history[-1][0]]
    by_step: Curves = {}
    for step, values in sorted(rows, key=lambda row: row[0]):
        numbers = {name: value for name, value in values.items() if not math.isnan(value)}
        by_step.setdefault(step, {}).update(numbers)
    return by_step


def _table(file: Path, group: str) -> list[tuple[int, dict[str, float]]]:
    """Return the step and the numbers of each row of a table."""
    header, rows = read_table(file)
    table = [dict(zip(header, row, strict=True)) for row in rows]
    others = [name for name in header if name not in {"step", "view"}]
    return [
        (int(row["step"]), {f"{group}/{name}": as_number(row[name]) for name in others})
        for row in table
    ]


def run_of(planned: PlannedCell, cell: CellFolder) -> Run:
    """Return how trackers name a planned cell, whose folder has its config."""
    from xrgs.store.results import cell_columns  # pandas is slow to load

    conf, spec = planned.conf, planned.spec
    config = {key: value for key, value in cell_columns(cell, None).items() if "." in key}
    return Run(
        cell.id,
        {
            "scene": scenes.label(conf.scene),
            "label": spec.label,
            "condition": spec.condition,
            "variant_seed": conf.variant.seed,
            "seed": conf.seed,
        },
        {k: v if isinstance(v, (str, float, int)) else str(v) for k, v in config.items()},
        conf.train.steps,
    )


class _Followed:
    """A cell whose curves are sent to a tracker, and which of its files were sent."""

    def __init__(self, planned: PlannedCell, cell: CellFolder) -> None:
        self.cell = cell
        self._planned = planned
        self._sink: Sink | None = None
        self._seen: tuple[float, ...] = ()
        """The times of the files that were sent last."""
        self.ended = False
        """Whether nothing more is to be sent: the cell is done, or can't be read."""

    def send(self, kind: str, folder: Path) -> None:
        """Send the steps that the tracker lacks.

        Raises:
            Exception: Whatever a package, a server or a disk raises. The next call asks the
                tracker for its last step, and goes on from there.
        """
        names = () if self.ended else ("history.csv", "status.json")
        written = tuple(when for name in names if (when := modified(self.cell.path / name)))
        if not written or written == self._seen:
            return
        state = self.cell.state(verify=False).name
        try:
            by_step = curves(self.cell, done=state == "done")
        except (StoreError, ValueError) as error:
            # Read again, if a new attempt is replacing the file or it can't be read now.
            self.ended = state == "done" and not isinstance(error, UnreadableError)
            if self.ended:
                log_line(f"{self.cell.id}: it is not tracked: {error}")
            return
        try:
            if self._sink is None:
                self._sink = SINKS[kind](run_of(self._planned, self.cell), folder)
            if new := {step: by_step[step] for step in by_step if step > self._sink.sent}:
                self._sink.send(new)
                self._sink.sent = max(new)
            if state in {"done", "failed"}:
                self.close(state)
        except BaseException:
            self._sink = None  # the next one reads its last step anew
            raise
        self._seen, self.ended = written, state == "done"

    def close(self, state: str) -> None:
        """End the run of a cell that is `done`, `failed` or `stopped`."""
        if self._sink is not None:
            self._sink.close(state)
            self._sink = None


class Tracker:
    """Follows the cells of a sweep in a thread while a `with` block runs."""

    def __init__(self, kind: str, store: Store) -> None:
        """Prepare to follow cells of a store; `kind` is a value of `track`."""
        self._kind = kind
        self._store = store
        self._folder = store.path / FOLDER / kind
        self._cells: dict[str, _Followed] = {}
        self._elsewhere: set[str | None] = set()
        """Cells that another sweep trains, and follows."""
        self._failed = self._has_said_so = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="xrgs-track", daemon=True)

    def watch(self, plan: Sequence[PlannedCell]) -> None:
        """Set the cells to follow; called again when they change."""
        for cell in plan:
            if cell.state.name == "running":
                self._elsewhere.add(cell.cell_id)
            elif cell.state.name != "done":  # its other sweep has left it
                self._elsewhere.discard(cell.cell_id)
        ours = {cell.cell_id: cell for cell in plan if cell.cell_id not in self._elsewhere}
        # A new dict, because the thread goes over the old one.
        self._cells = {
            name: self._cells.get(name) or _Followed(cell, self._store.cell(name))
            for name, cell in ours.items()
            if name is not None
        }

    def __enter__(self) -> Self:
        if self._kind != "none":
            log_line(f"track={self._kind}: {self._hint()}")
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._kind == "none":
            return
        self._thread.join(_END_S)
        late = self._thread.is_alive()
        if late or self._failed:
            why = f"no answer for {_END_S:.0f} s" if late else "it failed"
            log_line(
                f"track={self._kind}: {why}, and the curves there are not complete; the cells are"
                " in the store, and the same command sends the rest"
            )

    def _hint(self) -> str:
        """Return where people find the curves: a command, an address or a folder."""
        if self._kind == "tensorboard":
            return f"tensorboard --logdir {self._folder}"
        if self._kind == "mlflow":
            uri = mlflow_uri(self._folder)
            return f"mlflow ui --backend-store-uri {uri}" if uri.startswith("sqlite:") else uri
        if self._kind == "wandb":
            return f"with WANDB_MODE=offline, `wandb sync {self._folder}/offline-run-*` sends it"
        return str(self._folder)

    def _follow(self) -> None:
        while not self._stop.wait(_PAUSE_S if self._failed else _POLL_S):
            self.look()
        self.look()
        self.close()

    def look(self) -> None:
        """Send the new steps of each cell; print a message the first time that this fails."""
        self._failed = False
        for cell in self._cells.values():
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                cell.send(self._kind, self._folder)
            except Exception as error:  # of a package, a server or a disk
                self._failed = True
                if not self._has_said_so:
                    log_line(
                        f"track={self._kind}: {type(error).__name__}: {error}; the cells train on,"
                        f" and it is tried again every {_PAUSE_S:.0f} s"
                    )
                self._has_said_so = True

    def close(self) -> None:
        """End the runs that are still open: their cells were stopped."""
        for cell in self._cells.values():
            with suppress(Exception):  # the steps that were sent are there
                cell.close("stopped")
