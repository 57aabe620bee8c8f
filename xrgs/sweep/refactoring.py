"""Declares that a refactoring changes no number, after it was proven on a sample.

The ids of cells and of variants have the digest of each part of the code. Where code was changed so
that every bit stays the same, some done cells are trained again, or some variants are built again,
with the new code. If all bits are equal, the new digests are declared equal to the old ones
(`xrgs.safeio.refactorings`), so that everything keeps its id.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import saved_variant, variant
from xrgs.runtime.progress import log_line
from xrgs.safeio import refactorings
from xrgs.safeio.refactorings import ABSENT, canonical
from xrgs.safeio.sanitize import counted
from xrgs.store import identity, scoring
from xrgs.store.store import Store
from xrgs.sweep import build_variants
from xrgs.sweep.rerun import rerun

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.safeio.refactorings import Change
    from xrgs.store.cell_folder import CellFolder


@dataclass(frozen=True)
class Proof:
    """A sample that was made again to the same bits."""

    cells: tuple[str, ...]
    """Ids of the cells that were trained again."""
    variants: tuple[str, ...]
    """Ids of the variants that were built again."""
    parts: tuple[str, ...]
    """The parts of the code whose digests were declared equal."""

    def __str__(self) -> str:
        made = []
        if self.cells:
            made.append(f"{counted(len(self.cells), 'cell')} trained again")
        if self.variants:
            made.append(f"{counted(len(self.variants), 'variant')} built again")
        parts = ", ".join(self.parts)
        where = refactorings.FILE.name
        return f"{', '.join(made)}, the same bit for bit; declared in {where}: {parts}"


def prove(store: Store, cells: Sequence[CellFolder], sample: int = 2) -> Proof:
    """Make cells and variants again with the installed code; declare it equal where all bits are.

    Args:
        store: The store that has the cells and their variants.
        cells: Done cells. Those that the installed code has trained, on a variant that it has
            built, are passed over.
        sample: Number of cells or variants for each part of the code that has changed; the
            cells that take the shortest time are taken.

    Raises:
        XrgsError: Nothing was made with other code than the installed one, cells or variants were
            made with several codes, or a number differs; nothing is declared then.
    """
    done = [cell for cell in cells if cell.state(verify=False).name == "done"]
    done.sort(key=lambda cell: cell.summary().training_time_s)
    of_cells: dict[Change, list[CellFolder]] = {}
    of_variants: dict[Change, dict[str, CellFolder]] = {}
    for cell in done:
        for change in _changes(cell):
            of_cells.setdefault(change, []).append(cell)
        for change in _changes_of_variant(store, cell):
            of_variants.setdefault(change, {}).setdefault(cell.identity().variant, cell)
    changes = [*of_cells, *of_variants]
    if not changes:
        raise XrgsError(
            "no done cell was trained with other code than is installed, or on a variant that says"
            " it was built with other code (variants of earlier versions don't say)"
        )
    parts = [part for part, _, _ in changes]
    installed = [(part, new) for part, _, new in changes]
    if several := {part for part, new in installed if installed.count((part, new)) > 1}:
        raise XrgsError(
            f"cells were trained with several versions of {', '.join(sorted(several))}: name cells"
            " of one version"
        )
    trained = {cell.id: cell for of_one in of_cells.values() for cell in of_one[:sample]}
    built = {
        key: cell for of_one in of_variants.values() for key, cell in [*of_one.items()][:sample]
    }
    for variant_id, cell in built.items():
        _build_again(store, variant_id, cell)
    for cell in trained.values():
        _train_again(store, cell)
    refactorings.declare(changes)
    identity.training_code.cache_clear()
    scoring.scoring_code.cache_clear()
    return Proof(tuple(trained), tuple(built), tuple(dict.fromkeys(parts)))


def _changes(cell: CellFolder) -> list[Change]:
    """Return the parts of the code that trained and scored a cell and that have changed since."""
    trained = cell.identity()
    now, changed = identity.current_code(trained), identity.changed_code(trained)
    if any(part.startswith("plugins/") for part in changed):
        raise XrgsError(f"{cell.id}: a plugin has changed, which is no part of this package")
    if gone := [part for part in changed if part not in now]:
        raise XrgsError(f"{cell.id}: {', '.join(gone)} is not in the installed code")
    changes = [(part, trained.code.get(part, ABSENT), now[part]) for part in changed]
    return changes + _changes_of_scores(cell)


def _changes_of_scores(cell: CellFolder) -> list[Change]:
    """Return the scores of a cell whose code has changed since; a cell made again is scored too."""
    scored_by = cell.status().scored_by
    now = scoring.scoring_code(frozenset(scoring.on_request(scored_by)))
    changed = scoring.stale_scores(scored_by)
    return [(scoring.part_of(n), scored_by[n], now[n]) for n in changed if n in scored_by]


def _changes_of_variant(store: Store, cell: CellFolder) -> list[Change]:
    """Return the parts of the code that a cell's variant was built with and that have changed.

    A variant that is not in the store, or does not say which code has built it, has none.
    """
    try:
        built = saved_variant.read_manifest(store.variants / cell.identity().variant).code
    except StoreError:
        return []
    conf = cell.config()
    now = variant.all_code(conf.scene, conf.variant)
    changes = [(f"variant/{part}", built[part], now[part]) for part in now if part in built]
    return [(part, old, new) for part, old, new in changes if canonical(part, old) != new]


def _build_again(store: Store, variant_id: str, cell: CellFolder) -> None:
    log_line(f"variant {variant_id}: building again")
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        other = Store(Path(folder) / "store")
        other.prepare()
        again = saved_variant.read_manifest(
            other.variants / build_variants.build(cell.config(), other)
        )
    before = saved_variant.read_manifest(store.variants / variant_id)
    then, now = (msgspec.to_builtins(manifest) for manifest in (before, again))
    different = [
        name for name in then if name not in {"id", "key", "code"} and then[name] != now[name]
    ]
    if different:
        raise XrgsError(f"{variant_id}: {', '.join(different)} differ; nothing is declared")


def _train_again(store: Store, cell: CellFolder) -> None:
    log_line(f"{cell.id}: training again")
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        result = rerun(cell.path, Path(folder) / cell.id, store.path)
        if result.differences:
            raise XrgsError(f"{cell.id}: {'; '.join(result.differences)}; nothing is declared")
