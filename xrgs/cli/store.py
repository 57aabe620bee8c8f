"""`xrgs-store`: lists, shows, removes, trims, packs and verifies what a store keeps."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.cli.arguments import (
    answer,
    completion,
    errors_as_messages,
    names_in,
    parse_with_words,
)
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.runtime.signals import exit_on_signal
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from omegaconf import DictConfig

    from xrgs.sweep.cleaning import Plan
    from xrgs.sweep.inventory import CellSummary, Selection

_HELP = """\
xrgs-store list [FILTER]... [sort=name|age|size]
    Lists cells: id, scene, ablation, seed, state, age, size.
xrgs-store show CELL
    Shows one cell: how its config differs from its baseline, scores, files, provenance, sweeps.
xrgs-store rm [CELL]... [FILTER]... [dry_run=true] [yes=true]
    Removes cells; at least one must be named or a filter given.
xrgs-store trim [CELL]... [FILTER]... [variants=true] [dry_run=true] [yes=true]
    Removes the Gaussians and renders of done cells, of all by default. The cells stay done, and
    tables of them can be made. variants=true also removes the images of their variants, which a
    sweep with further cells makes again from the photographs.
xrgs-store pack [CELL]... [FILTER]... out=FILE.tar.xz
    Packs done cells, all by default, into an archive for others: without Gaussians and renders,
    with their variants without images, and with the records of their sweeps, or of those that
    sweep= names. Full paths in configs and commands become relative. Unpacked, it is a store:
    reports can be made, sweeps continued.
xrgs-store gc [of=NAMES] [dry_run=true] [yes=true]
    Removes what no sweep of the installed code needs; of= chooses among old_code (cells that other
    code has trained), failed (tries of cells and scenes), aside (folders of earlier attempts that
    were set aside) and variants (of which no cell is left). All of it by default.
xrgs-store check
    Hashes every file of the finished cells, the variants, the rendered scenes and the records of
    sweeps, and ends with code 1 if a file is damaged or can't be read.

  store=FOLDER     the store; xrgs-store by default
  CELL             id of a cell, or as much of it as no other id begins with
  FILTER           scenes=NAMES ablations=NAMES states=NAMES sweep=IDS older_days=N larger_mb=N;
                   names and ids are separated by commas; states are done, running, unfinished,
                   failed, corrupt and unknown; sweep= chooses the cells of these sweeps
  dry_run=true     say what would be removed, and how much, and stop
  yes=true         remove it without asking; without it, and without a terminal to ask on, nothing
                   is removed

Cells that are being trained, here or on another machine, are never touched.
"""


@dataclass
class FilterConf:
    """Which cells of which store are meant."""

    store: str = "xrgs-store"
    """The store's folder."""
    scenes: str = ""
    ablations: str = ""
    states: str = ""
    sweep: str = ""
    older_days: float = 0.0
    larger_mb: float = 0.0


@dataclass
class ListConf(FilterConf):
    """Arguments of `xrgs-store list`."""

    sort: str = "name"


@dataclass
class RemoveConf(FilterConf):
    """Arguments of `xrgs-store rm`."""

    dry_run: bool = False
    yes: bool = False


@dataclass
class TrimConf(RemoveConf):
    """Arguments of `xrgs-store trim`."""

    variants: bool = False


@dataclass
class PackConf(FilterConf):
    """Arguments of `xrgs-store pack`."""

    out: str = ""


@dataclass
class GcConf:
    """Arguments of `xrgs-store gc`."""

    store: str = "xrgs-store"
    of: str = "old_code,failed,aside,variants"
    dry_run: bool = False
    yes: bool = False


@dataclass
class StoreConf:
    """Arguments of `xrgs-store show` and `xrgs-store check`."""

    store: str = "xrgs-store"


def main() -> None:
    """Run `xrgs-store COMMAND [CELL]... [KEY=VALUE]...`."""
    if "--completion" in sys.argv[1:]:
        keys = dict.fromkeys(f"{key}=" for conf, _ in _COMMANDS.values() for key in vars(conf()))
        say(completion("xrgs-store", [*_COMMANDS, *keys]))
        return
    answer(ListConf, _HELP, sys.argv[1:] or ["--help"])
    command = sys.argv[1]
    with errors_as_messages("xrgs-store"):
        if command not in _COMMANDS:
            known = ", ".join(_COMMANDS)
            raise XrgsError(f"{command}: there is no such command; choose from: {known}")
        schema, run = _COMMANDS[command]
        with exit_on_signal("What was not removed yet is unchanged."):
            words, conf = parse_with_words(schema, _HELP, sys.argv[2:])
            run(conf, words)


def _list(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.sweep.inventory import list_cells

    _, chosen = _chosen(conf, words)
    say(list_cells(chosen, conf.sort))


def _show(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.sweep.inventory import one_cell, summaries
    from xrgs.sweep.show import show

    if len(words) != 1:
        raise XrgsError("show: give the id of one cell, or its beginning")
    store = Store(Path(conf.store))
    say(show(store, one_cell(words[0], summaries(store))))


def _remove(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.sweep.cleaning import plan_removal

    store = Store(Path(conf.store))
    if not _selection(conf, words).restricts:
        raise XrgsError("rm: name cells, or give a filter; see xrgs-store --help")
    _, chosen = _chosen(conf, words)
    _carry_out(conf, store, plan_removal(store, chosen))


def _trim(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.sweep.cleaning import plan_trim

    store = Store(Path(conf.store))
    cells, chosen = _chosen(conf, words)
    _carry_out(conf, store, plan_trim(store, cells, chosen, variants=conf.variants))


def _pack(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.sweep.inventory import size_text
    from xrgs.sweep.packing import pack

    out = user_path(conf.out)
    if not out.name.endswith(".tar.xz"):
        raise XrgsError(f"pack: out={conf.out}: name the archive to write, FILE.tar.xz")
    _, chosen = _chosen(conf, words)
    done = [cell for cell in chosen if cell.state.name == "done"]
    packed = pack(Store(Path(conf.store)), done, out, Path.cwd(), names_in(conf.sweep))
    say(f"{out}: {packed}; {size_text(packed.bytes)}")
    if len(done) < len(chosen):
        say(f"left out, not done: {counted(len(chosen) - len(done), 'cell')}")
    _say_left(packed.left_out)


def _gc(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.sweep.cleaning import plan_gc
    from xrgs.sweep.inventory import summaries

    _no_words("gc", words)
    store = Store(Path(conf.store))
    _carry_out(conf, store, plan_gc(store, summaries(store), names_in(conf.of)))


def _check(conf: DictConfig, words: Sequence[str]) -> None:
    from xrgs.experiment.verification import describe, verify

    _no_words("check", words)
    verification = verify(Store(Path(conf.store)))
    say(describe(verification))
    if verification.damage:
        sys.exit(1)


def _no_words(command: str, words: Sequence[str]) -> None:
    if words:
        raise XrgsError(f"{command} {' '.join(words)}: {command} takes no cells")


def _chosen(conf: DictConfig, words: Sequence[str]) -> tuple[list[CellSummary], list[CellSummary]]:
    """Return all cells of the store, and those that are meant."""
    from xrgs.sweep.inventory import summaries

    cells = summaries(Store(Path(conf.store)))
    return cells, _selection(conf, words).of(cells)


def _selection(conf: DictConfig, words: Sequence[str]) -> Selection:
    from xrgs.sweep.inventory import Selection

    return Selection(
        tuple(words),
        names_in(conf.scenes),
        names_in(conf.ablations),
        names_in(conf.states),
        names_in(conf.sweep),
        float(conf.older_days),
        float(conf.larger_mb),
    )


def _carry_out(conf: DictConfig, store: Store, plan: Plan) -> None:
    """Say what a plan does, and do it if that is confirmed.

    Raises:
        SystemExit: With a message and code 1 where it is not confirmed, or something was left.
    """
    from xrgs.sweep.cleaning import carry_out
    from xrgs.sweep.inventory import size_text

    say(str(plan))
    if conf.dry_run or not plan.items:
        return
    if not (conf.yes or _confirmed(f"{plan.verb} {plan.total}?")):
        sys.exit("xrgs-store: nothing was done; yes=true does it without asking")
    freed, left = carry_out(store, plan)
    say(f"freed {size_text(freed)}")
    _say_left(left)


def _say_left(lines: Sequence[str]) -> None:
    """Say what was left, and why.

    Raises:
        SystemExit: With code 1, where anything was.
    """
    for line in lines:
        say(line, sys.stderr)
    if lines:
        sys.exit(1)


def _confirmed(question: str) -> bool:
    """Ask on the terminal; without one, nobody has answered."""
    if not sys.stdin.isatty():
        return False
    say(f"{question} [y/N]", sys.stderr)
    return sys.stdin.readline().strip().lower() in {"y", "yes"}


_COMMANDS: dict[str, tuple[type[Any], Callable[[Any, Sequence[str]], None]]] = {
    "list": (ListConf, _list),
    "show": (StoreConf, _show),
    "rm": (RemoveConf, _remove),
    "trim": (TrimConf, _trim),
    "pack": (PackConf, _pack),
    "gc": (GcConf, _gc),
    "check": (StoreConf, _check),
}
