"""`xrgs-store`: lists, removes, packs, imports, rescores and verifies the content of a store."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from xrgs.cli import options
from xrgs.cli.options import STORE, Cells, Flag, Folder, Names, shown_as
from xrgs.errors import XrgsError
from xrgs.runtime.streams import say
from xrgs.safeio.sanitize import counted
from xrgs.splat.settings import outside_limits
from xrgs.store.listing import CellRow
from xrgs.store.store import Store
from xrgs.sweep.cleaning import Plan

#: The limits of an age or a size.
_AMOUNT = {"least": 0, "finite": True}


@dataclass(frozen=True)
class Filter:
    """Options that choose cells of a store."""

    ids: Positional[Cells] = ()
    """Cells: ids, beginnings of ids, or scenes with one done cell; all by default."""
    scenes: Names = ()
    """Only cells of these scenes."""
    ablations: Names = ()
    """Only cells of these ablations."""
    states: Names = ()
    """Only cells in these states: done, running, planned, unfinished, failed, corrupt."""
    sweep: Annotated[tuple[str, ...], shown_as("ID ...")] = ()
    """Only cells of these sweeps; xrgs-report list has the ids."""
    older_days: Annotated[float, shown_as("DAYS")] = field(default=0.0, metadata=_AMOUNT)
    """Only cells of at least this age."""
    larger_mb: Annotated[float, shown_as("MB")] = field(default=0.0, metadata=_AMOUNT)
    """Only cells of at least this size."""
    store: Folder = STORE
    """The store."""

    def chosen(self) -> tuple[list[CellRow], list[CellRow]]:
        """Return all cells of the store, and the chosen ones.

        Raises:
            XrgsError: No cell has a name that is given, several ids have one beginning, or an
                amount is below 0.
        """
        from xrgs.store.listing import STATES, full_id

        for message in outside_limits(self):
            raise XrgsError(message)
        cells = Store(self.store).cell_rows()
        done = [cell for cell in cells if cell.state.name == "done"]
        named = {
            full_id(
                word,
                [cell.id for cell in cells],
                done={cell.id: cell.arm for cell in done if cell.scene == word},
            )
            for word in self.ids
        }
        for key, names, existing in (
            ("scenes", self.scenes, [cell.scene for cell in cells]),
            ("ablations", self.ablations, [cell.label for cell in cells]),
            ("states", self.states, STATES),
            ("sweep", self.sweep, [name for cell in cells for name in cell.sweeps]),
        ):
            for name in names:
                if name not in existing:
                    choices = ", ".join(dict.fromkeys(existing)) or "none"
                    raise XrgsError(f"{key}={name}: no cell has that; choose from: {choices}")
        return cells, [
            cell
            for cell in cells
            if (not named or cell.id in named)
            and (not self.scenes or cell.scene in self.scenes)
            and (not self.ablations or cell.label in self.ablations)
            and (not self.states or cell.state.name in self.states)
            and (not self.sweep or not {*self.sweep}.isdisjoint(cell.sweeps))
            and (not self.older_days or (cell.age_s or 0.0) >= 86400 * self.older_days)
            and (not self.larger_mb or (cell.bytes or 0) >= 1e6 * self.larger_mb)
        ]


@dataclass(frozen=True)
class Removal:
    """Options of commands that remove files; without `yes` they ask on the terminal."""

    dry_run: Flag = False
    """Say what would be removed and its size, and stop."""
    yes: Flag = False
    """Remove it without asking."""

    def carry_out(self, store: Store, plan: Plan) -> None:
        """Print a plan of removal, and carry it out if it is confirmed.

        Raises:
            XrgsError: The plan is not confirmed.
            SystemExit: With code 1, if something could not be removed.
        """
        from xrgs.runtime.text import format_size
        from xrgs.sweep.cleaning import carry_out

        say(str(plan))
        if self.dry_run or not plan.items:
            return
        if not (self.yes or _confirmed(f"{plan.verb} {plan.total}?")):
            raise XrgsError("nothing was done; --yes does it without asking")
        freed, remaining = carry_out(store, plan)
        say(f"freed {format_size(freed)}")
        _say_left(remaining)


def list_cells(cells: Filter, sort: Literal["name", "age", "size"] = "name") -> None:
    """List cells: id, scene, ablation, seed, state, age, size.

    Args:
        cells: The cells that pass all of these options.
        sort: The order; the oldest or the largest cell is last.
    """
    from xrgs.sweep import status

    say(status.list_cells(cells.chosen()[1], sort))


def show(cell: Positional[Annotated[str, shown_as("CELL")]] = "", store: Folder = STORE) -> None:
    """Show a cell: how its config differs from its baseline, scores, files, provenance, sweeps.

    Args:
        cell: The cell's id, the beginning of its id, or the name of a scene with one done cell.
        store: The store.
    """
    from xrgs.sweep.status import show as described

    if not cell:
        raise XrgsError("show: give a cell")
    _, (chosen,) = Filter((cell,), store=store).chosen()
    say(described(Store(store), chosen))


def rm(cells: Filter, removal: Removal) -> None:
    """Remove cells, which must be named or chosen by an option.

    Args:
        cells: The cells that pass all of these options.
        removal: Without --yes the command asks; without a terminal, nothing is removed.
    """
    from xrgs.sweep.cleaning import plan_removal

    if replace(cells, store=STORE) == Filter():
        raise XrgsError("rm: name cells, or choose them by an option; see xrgs-store rm --help")
    store = Store(cells.store)
    removal.carry_out(store, plan_removal(store, cells.chosen()[1]))


def trim(cells: Filter, removal: Removal, variants: Flag = False) -> None:
    """Remove the Gaussians and renders of done cells.

    The cells stay done, and their tables can still be made.

    Args:
        cells: The cells that pass all of these options.
        removal: Without --yes the command asks; without a terminal, nothing is removed.
        variants: Also remove the images of their variants. A sweep with further cells makes the
            images again from the photographs.
    """
    from xrgs.sweep.cleaning import plan_trim

    store = Store(cells.store)
    removal.carry_out(store, plan_trim(store, *cells.chosen(), variants=variants))


def pack(cells: Filter, out: Annotated[Path, arg(metavar="FILE.tar.xz")]) -> None:
    """Pack done cells into an archive for others.

    The archive has the cells without Gaussians and renders, their variants without images, and the
    records of their sweeps, or of those in --sweep. Full paths in configs and commands become
    relative. Unpacked, it is a store: reports can be made, and sweeps continued.

    Args:
        cells: The cells that pass all of these options.
        out: The archive to write.
    """
    from xrgs.runtime.text import format_size
    from xrgs.store import archive

    if not out.name.endswith(".tar.xz"):
        raise XrgsError(f"--out {out}: name the archive to write, FILE.tar.xz")
    _, chosen = cells.chosen()
    done = [cell.folder for cell in chosen if cell.state.name == "done"]
    if not done:
        raise XrgsError("pack: none of the chosen cells is done; xrgs-store list has all")
    packed = archive.pack(Store(cells.store), done, out, Path.cwd(), cells.sweep)
    say(f"{out}: {packed}; {format_size(packed.bytes)}")
    if len(done) < len(chosen):
        say(f"left out, not done: {counted(len(chosen) - len(done), 'cell')}")
    _say_left(packed.left_out)


def import_(
    source: Positional[Annotated[Path | None, shown_as("ARCHIVE|FOLDER")]] = None,
    store: Folder = STORE,
) -> None:
    """Copy the store of somebody else into this one, after every file is checked.

    Unfinished cells, checkpoints, logs and reports are not imported. Damaged cells and variants are
    left out and named. An import that was stopped continues when it is run again.

    Args:
        source: An archive (.tar, .tar.xz, .tar.gz), or the folder of a store.
        store: The store to copy to.
    """
    from xrgs.store import archive

    if source is None:
        raise XrgsError("import: give an archive, or the folder of a store")
    imported = archive.import_store(source, Store(store))
    say(f"{source}: imported: {imported}; already there: {imported.present}")
    _say_left(imported.left_out)


def gc(
    removal: Removal,
    of: Names = ("old_code", "failed", "aside", "variants"),
    store: Folder = STORE,
) -> None:
    """Remove what no sweep of the installed code needs.

    Args:
        removal: Without --yes the command asks; without a terminal, nothing is removed.
        of: Kinds to remove, all by default: old_code (cells trained by other code), failed (failed
            attempts of cells and scenes), aside (folders of earlier attempts that were set aside),
            variants (without cells).
        store: The store.
    """
    from xrgs.sweep.cleaning import plan_gc

    removal.carry_out(Store(store), plan_gc(Store(store), Store(store).cell_rows(), of))


def rescore(cells: Filter, also: Names = ()) -> None:
    """Score done cells again after a metric was added or changed; nothing is trained.

    The cells' Gaussians are rendered and scored by the installed metrics. Cells that the installed
    code has scored are skipped.

    Args:
        cells: The cells that pass all of these options.
        also: Slow scores to add: lpips_vgg, which takes 3 s for a view of 500 x 375 px. Its weights
            are fetched by `xrgs-data lpips --network vgg`.
    """
    from xrgs.store.scoring import rescore as score_anew

    _, chosen = cells.chosen()
    done = [cell.folder for cell in chosen if cell.folder.status_file.exists()]
    text, is_complete = score_anew(Store(cells.store), done, also)
    say(text)
    if not is_complete:
        sys.exit(1)


def check(store: Folder = STORE) -> None:
    """Hash every file of the finished cells, the variants, the rendered scenes and the sweeps.

    It ends with code 1 if a file is damaged or can't be read.

    Args:
        store: The store.
    """
    from xrgs.store.verification import verify

    text, damage = verify(Store(store))
    say(text)
    if damage:
        sys.exit(1)


def _say_left(lines: Sequence[str]) -> None:
    """Print lines on what was left out or not removed, to stderr.

    Raises:
        SystemExit: With code 1, if there is any line.
    """
    for line in lines:
        say(line, sys.stderr)
    if lines:
        sys.exit(1)


def _confirmed(question: str) -> bool:
    """Ask on the terminal; without a terminal the answer is no."""
    if not sys.stdin.isatty():
        return False
    say(f"{question} [y/N]", sys.stderr)
    return sys.stdin.readline().strip().lower() in {"y", "yes"}


def main() -> None:
    """Run `xrgs-store`."""
    description = (
        "List, remove, pack, import, score anew and verify what a store keeps. Cells that are being"
        " trained, here or on another machine, are never touched."
    )
    functions: dict[str, Callable[..., None]] = {
        "list": list_cells,
        "show": show,
        "rm": rm,
        "trim": trim,
        "pack": pack,
        "import": import_,
        "gc": gc,
        "rescore": rescore,
        "check": check,
    }
    hint = "What was not removed yet is unchanged."
    options.run("xrgs-store", functions, description, hint=hint)
