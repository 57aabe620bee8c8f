"""Writes the end of a run's output: its done cells, and the commands that come next."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.runtime.text import TextTable, to_text
from xrgs.safeio.sanitize import counted, for_file_name
from xrgs.store.store import DEFAULT_STORE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.sweep.plan import PlannedCell

#: The most cells that are listed with their ids.
_MAX_LISTED = 12
#: Number of characters of a cell's id in a command.
_ID = 8


def ending(plan: Sequence[PlannedCell], store: Path) -> str:
    """Return the text after a sweep's report: the ids of its done cells, and commands to go on."""
    done = [cell for cell in plan if cell.cell_id and cell.state.name == "done"]
    if not done:
        return ""
    rows = tuple((str(cell.cell_id), cell.name) for cell in done[:_MAX_LISTED])
    more = len(done) - _MAX_LISTED
    notes = (f"and {more} more: xrgs-status lists them",) if more > 0 else ()
    table = TextTable(counted(len(done), "done cell"), ("cell", "name"), rows, "ll", notes)
    last = done[-1]
    # Its baseline, where the two share a variant: no camera shows the same in two variants.
    alike = (last.spec.shared, last.variant_id)
    first = next(cell for cell in done if (cell.spec.shared, cell.variant_id) == alike)
    shown = list(dict.fromkeys(str(cell.cell_id)[:_ID] for cell in (first, last)))
    commands = next_commands(shown, last.spec.label, store)
    return "\n".join([to_text(table), "Next:", *(f"  {line}" for line in commands)])


def next_commands(cells: Sequence[str], name: str, store: Path) -> list[str]:
    """Return the commands that show trained cells, make a film of them, and export the last.

    The cells are one, or two of one variant, as a command takes them. The files that are written
    get the name, and a suffix.
    """
    words = shlex.join(cells)
    where = "" if store == DEFAULT_STORE else f" --store {shlex.quote(str(store))}"
    file = shlex.quote(for_file_name(name))
    return [
        f"xrgs-view {words}{where}",
        f"xrgs-render {words} --out {file}.mp4{where}",
        f"xrgs-data export {shlex.quote(cells[-1])} --out {file}.ply{where}",
    ]
