"""Scores done cells anew, after a metric was added or changed; nothing is trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.errors import StoreError, XrgsError
from xrgs.evaluation.metrics import ON_REQUEST, also_scored
from xrgs.runtime import lease
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import write_text
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.records import table_text
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store.identity import changed_code
from xrgs.store.scoring import on_request, scoring_code, stale_scores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.store.cell_folder import CellFolder
    from xrgs.store.store import Store

_SPLATS = "splats.ply"


@dataclass(frozen=True)
class Rescored:
    """The result of `rescore`."""

    scored: tuple[str, ...]
    """Ids of the cells that were scored anew."""
    current: int
    """Number of cells whose scores were of the installed code already."""
    left: tuple[str, ...]
    """A line for each cell that could not be scored, with the reason."""

    def __str__(self) -> str:
        lines = [f"left: {line}" for line in self.left]
        current = f"{counted(self.current, 'cell')} had the scores of this code already"
        lines.append(f"scored {counted(len(self.scored), 'cell')} anew; {current}")
        return "\n".join(map(for_line, lines))


def rescore(store: Store, cells: Sequence[CellFolder], also: Sequence[str] = ()) -> Rescored:
    """Score done cells anew where their scores lack a metric, or are of other code.

    The views are rendered from the cell's Gaussians, as after its training, and `scores.csv` and
    the renders are replaced. A cell that is being trained, is not done, has no Gaussians any more,
    or was trained with another rasterizer is left as it is.

    Scores of `ON_REQUEST` that are named in `also` are added. A cell that has one keeps it.

    Raises:
        XrgsError: The store can't be written, or a score is none of `ON_REQUEST`.
    """
    if unknown := sorted(set(also) - ON_REQUEST):
        raise XrgsError(f"also={unknown[0]}: choose from: {', '.join(sorted(ON_REQUEST))}")
    added = frozenset(also)
    scored, left, current = [], [], 0
    for cell in progress(cells, "scoring", "cell", len(cells)):
        try:
            if not stale_scores(_done(cell), added):
                current += 1
                continue
            if (held := lease.acquire(store.leases, cell.id)) is None:
                raise StoreError("a sweep is training it")
            try:
                _score(cell, added)
            finally:
                held.release()
            scored.append(cell.id)
        except XrgsError as error:
            left.append(f"{cell.id}: {error}")
        except OSError as error:
            raise StoreError(f"store={store.path}: {error}") from error
    return Rescored(tuple(scored), current, tuple(left))


def _done(cell: CellFolder) -> dict[str, str]:
    """Return the digests of the code that has scored a done cell."""
    if not cell.status_file.exists():
        raise StoreError("it is not done")
    status = cell.status()
    if status.state != "done":
        raise StoreError(f"it failed: {status.reason}")
    return status.scored_by


def _score(cell: CellFolder, also: frozenset[str]) -> None:
    from xrgs.evaluation import protocol

    if parts := changed_code(cell.identity()):
        raise StoreError(
            f"it was trained with other code ({', '.join(parts)}), which may render its Gaussians"
            " otherwise: train it again"
        )
    cell.check_not_trimmed(_SPLATS)
    if file_digest(cell.path / _SPLATS) != cell.status().files[_SPLATS].sha256:
        raise StoreError(f"{_SPLATS} has changed since the cell finished")
    views, settings = cell.dataset().test, cell.config().splat
    requested = also | on_request(cell.status().scored_by)
    with also_scored(requested):
        rows = protocol.score_views(cell.gaussians(), views, settings, cell.path / "renders")
    # A kill between these two writes leaves scores that differ from the status: the cell is corrupt
    # until it is scored again.
    write_text(cell.path / "scores.csv", table_text(rows))
    renders = [f"renders/{view.name}.png" for view in views]
    cell.rescored(["scores.csv", *renders], scoring_code(requested))
