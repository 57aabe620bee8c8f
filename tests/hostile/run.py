"""Runs the commands on hostile stores, each in a forked process, and judges what they do.

    python -m tests.hostile.run [--theme THEME]... [--case NAME]... [--out FILE.csv]

A case makes a copy of a finished store hostile; then each command that reads the part that was
changed looks at it. A command must end by itself with exit code 0, 1 or 2, within 5 CPU seconds and
1 GB, without a traceback, without a character that a terminal obeys, and without writing outside
the store; it must name the file that is at fault and still show what is healthy. The table has one
row a command; the exit code is 1 where a verdict is not "ok".
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from functools import partial
from importlib import import_module
from pathlib import Path

from tests.hostile import judge, reference, sandbox
from tests.hostile.looks import Look, Maker
from tests.hostile.themes import THEMES
from xrgs.runtime.machine import set_passive_openmp_wait

#: Imported before the first fork, since every command would import them anew.
_PRELOADED = (
    *(f"xrgs.cli.{name}" for name in ("data", "report", "status", "sweep")),
    *("xrgs.report", "xrgs.report.figures", "xrgs.report.html.trained", "xrgs.report.variant"),
    *("xrgs.sweep.status", "xrgs.sweep.rerun", "xrgs.sweep.study", "xrgs.experiment.results"),
    "hydra_plugins",
)

#: How many times longer a command may take that trains a cell.
_TRAINING = 4


@dataclass(frozen=True)
class Row:
    """What one command did on one store."""

    theme: str
    case: str
    command: str
    exit_code: str
    wall_s: str
    cpu_s: str
    rss_mb: int
    verdict: str
    last_line: str


def run_case(name: str, make: Maker, base: Path, folder: Path, wall_s: float) -> Iterator[Row]:
    """Make a store hostile and judge every look at it.

    Args:
        name: `theme/case`.
        make: The function that makes it hostile.
        base: The reference store.
        folder: A new folder for the case.
        wall_s: Seconds after which a command is killed.
    """
    store, outside = folder / "store", folder / "OUTSIDE"
    outside.mkdir(parents=True)
    (outside / "victim.txt").write_text("unchanged\n")
    shutil.copytree(base, store)
    looks = make(store)
    kept_out = [
        store,
        *(folder / f"look-{n}{end}" for n in range(len(looks)) for end in ("", ".out")),
    ]
    before = judge.snapshot(folder, *kept_out)
    theme, _, case = name.partition("/")
    for number, look in enumerate(looks):
        limit = _TRAINING * wall_s if look.can_train else wall_s
        ended = sandbox.run(partial(_program, look), folder / f"look-{number}", limit)
        found = list(judge.verdicts(look, ended))
        if look.command == "report":
            found += judge.report_verdicts(store)
        if (folder / "canary").exists():
            found.append("executed")
        after = judge.snapshot(folder, *kept_out)
        if written := judge.changed(before, after):
            found.append(f"written outside ({written[0].removeprefix(str(folder))!a})")
            before = after
        lines = ended.output.decode("utf-8", "replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        yield Row(
            theme,
            case,
            look.title,
            "killed" if ended.hung else str(ended.code),
            f"{ended.wall_s:.2f}",
            f"{ended.cpu_s:.2f}",
            ended.peak_rss // 10**6,
            "; ".join(found) or "ok",
            ascii(said[-1])[:200] if said else "",
        )


def _program(look: Look) -> None:
    """Be the command."""
    if look.command == "cells":
        _print_cells(Path(look.arguments[0]))
        return
    sys.argv = [f"xrgs-{look.command}", *look.arguments]
    main: Callable[[], None] = import_module(f"xrgs.cli.{look.command}").main
    main()


def _print_cells(store: Path) -> None:
    """Print the cells of a store as a program would that uses the Python interface."""
    from xrgs.errors import XrgsError
    from xrgs.experiment.store import Store

    try:
        table = Store(store).cells()
    except XrgsError as error:
        sys.exit(str(error))
    for state, count in table["state"].value_counts().items():
        print(count, state)  # noqa: T201
    columns = ["scene", "label", "seed", "variant", "reason", "psnr", "gaussians"]
    print(table[columns].to_string(max_colwidth=None))  # noqa: T201


def chosen(themes: Sequence[str], names: Sequence[str]) -> dict[str, Maker]:
    """Return the cases of some themes, or all; `names` are parts of their names."""
    cases = {
        f"{theme}/{name}": make
        for theme, of in THEMES.items()
        if not themes or theme in themes
        for name, make in of.items()
    }
    wanted = {c: m for c, m in cases.items() if not names or any(name in c for name in names)}
    if not wanted:
        raise SystemExit(f"there is no such case; the themes are {', '.join(THEMES)}")
    return wanted


def run_cases(cases: dict[str, Maker], work: Path, wall_s: float, *, keep: bool) -> Iterator[Row]:
    """Run cases one after another, each in a folder of its own, which is removed unless `keep`."""
    set_passive_openmp_wait()  # before torch is imported
    for module in _PRELOADED:
        import_module(module)
    base = work / "reference"
    reference.build(base)
    for number, (name, make) in enumerate(cases.items()):
        folder = work / f"case-{number}"
        try:
            yield from run_case(name, make, base, folder, wall_s)
        finally:
            if not keep:
                _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a folder, however deep it is and whatever its modes are."""
    # shutil.rmtree gives up on deep folders.
    for command in (["/bin/chmod", "-R", "u+rwx"], ["/bin/rm", "-rf"]):
        subprocess.run([*command, str(folder)], check=False, capture_output=True)


def write_table(rows: Iterable[Row], out: Path | None) -> list[Row]:
    """Print a line for each row as it comes, write it to a CSV table as well, and return all."""
    done = []
    with (out or Path(os.devnull)).open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(field.name for field in fields(Row))
        for row in rows:
            done.append(row)
            writer.writerow(astuple(row))
            stream.flush()
            print(  # noqa: T201
                f"{row.theme}/{row.case:40} {row.command:8} {row.exit_code:>6} {row.wall_s:>6} s "
                f"{row.rss_mb:5} MB  {row.verdict}",
                flush=True,
            )
    return done


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Run the commands on hostile stores.")
    parser.add_argument("--theme", action="append", default=[], help=", ".join(THEMES))
    parser.add_argument("--case", action="append", default=[], help="part of a case's name")
    parser.add_argument("--out", type=Path, help="CSV table to write")
    parser.add_argument("--work", type=Path, help="keep the stores and outputs in this new folder")
    parser.add_argument("--wall", type=float, default=judge.MAX_WALL_S, help="seconds a command")
    options = parser.parse_args(arguments)
    cases = chosen(options.theme, options.case)
    with tempfile.TemporaryDirectory(prefix="xrgs-hostile-") as temporary:
        work = options.work or Path(temporary)
        os.environ["XRGS_CACHE"] = f"{temporary}/cache"  # no weights of LPIPS: the same everywhere
        rows = write_table(
            run_cases(cases, work.absolute(), options.wall, keep=options.work is not None),
            options.out,
        )
    bad = [row for row in rows if row.verdict != "ok"]
    print(f"{len(cases)} cases, {len(rows)} commands, {len(bad)} not ok")  # noqa: T201
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
