"""Declares that a refactoring changes no number, after it was proven by training cells again.

A cell's identity has the digest of each part of the code. Where code was changed so that every
bit stays the same, a sample of done cells is trained again with the new code. If all bits are
equal, the new digests are declared equal to the old ones in `xrgs/experiment/refactorings.json`, so
that all cells keep their ids.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.experiment import identity
from xrgs.runtime.progress import log_line
from xrgs.safeio.atomic import write_json
from xrgs.safeio.sanitize import counted
from xrgs.sweep.rerun import rerun

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.experiment.cell_folder import CellFolder
    from xrgs.experiment.store import Store

#: Name of a part, its old digest and its new one.
_Change = tuple[str, str, str]


@dataclass(frozen=True)
class Proof:
    """A sample of cells that was trained again to the same bits."""

    cells: tuple[str, ...]
    parts: tuple[str, ...]
    """The parts of the code whose digests were declared equal."""

    def __str__(self) -> str:
        cells = f"{counted(len(self.cells), 'cell')} trained again, the same bit for bit"
        return f"{cells}; declared in {identity.REFACTORINGS.name}: {', '.join(self.parts)}"


def prove(store: Store, cells: Sequence[CellFolder], sample: int = 2) -> Proof:
    """Train cells again with the installed code, and declare it equal where all bits are.

    Args:
        store: The store that has the cells and their variants.
        cells: Done cells that the code before the refactoring has trained; others are passed over.
        sample: Number of cells for each part of the code that has changed; the shortest are taken.

    Raises:
        XrgsError: No done cell was trained with other code than the installed one, cells were
            trained with several codes, or a number differs; nothing is declared then.
    """
    changes: dict[_Change, list[CellFolder]] = {}
    for cell in cells:
        if cell.state(verify=False).name == "done":
            for change in _changes(cell):
                changes.setdefault(change, []).append(cell)
    if not changes:
        raise XrgsError("no done cell was trained with other code than is installed")
    parts = [part for part, _, _ in changes]
    if several := {part for part in parts if parts.count(part) > 1}:
        raise XrgsError(
            f"cells were trained with several versions of {', '.join(sorted(several))}: name cells"
            " of one version"
        )
    chosen = {
        cell.id: cell
        for of_change in changes.values()
        for cell in sorted(of_change, key=lambda cell: cell.summary().training_time_s)[:sample]
    }
    for cell in chosen.values():
        _train_again(store, cell)
    _declare(list(changes))
    return Proof(tuple(chosen), tuple(parts))


def _changes(cell: CellFolder) -> list[_Change]:
    """Return the parts of the code that a cell was trained with and that have changed since."""
    trained = cell.identity()
    now, changed = identity.current_code(trained), identity.changed_code(trained)
    if any(part.startswith("plugins/") for part in changed):
        raise XrgsError(f"{cell.id}: a plugin has changed, which is no part of this package")
    if new := [part for part in changed if part not in trained.code or part not in now]:
        raise XrgsError(f"{cell.id}: {', '.join(new)} is not in both versions of the code")
    return [(part, trained.code[part], now[part]) for part in changed]


def _train_again(store: Store, cell: CellFolder) -> None:
    log_line(f"{cell.id}: training again")
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        result = rerun(cell.path, Path(folder) / cell.id, store.path)
        if result.differences:
            raise XrgsError(f"{cell.id}: {'; '.join(result.differences)}; nothing is declared")


def _declare(changes: Sequence[_Change]) -> None:
    declared = identity.refactorings()
    for part, old, new in changes:
        declared.setdefault(part, {})[new] = old
    try:
        write_json(identity.REFACTORINGS, declared)
    except OSError as error:
        raise XrgsError(f"{identity.REFACTORINGS}: {error.strerror}") from error
    identity.training_code.cache_clear()
