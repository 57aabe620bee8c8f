"""How long planning, reporting and looking take over a store of many finished cells.

The commands are run as a user runs them. One cell is trained; the others are copies of it, under
the ids that a plan asks for and with their own seed, their pictures and splats as links to its.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from collections.abc import Iterator

_LABELS = ("loss_weighting", "gradient_scaling", "curriculum", "consistency")
_CELL = ("scene=motorcycle", "preset=smoke", "train.steps=2", "store=store")
_LINE = re.compile(r"^  \w+ +([0-9a-f]{16}) .*/ seed (\d+)$", re.MULTILINE)
_LINKED = {".png": "renders", ".ply": "splats"}


def measure(cells: int, out: Path) -> dict[str, Any]:
    """Time each command over so many cells.

    Args:
        cells: how many, the multiple of 5 below it: of a baseline and four ablations each.
        out: folder in which the store is made, and cleared away again.

    Returns:
        `cells`, how many; `commands`, rows of `command`, `seconds`, `cpu_seconds` (of it and of all
        that it started) and `ms_per_cell`; and of a cell `files`, `inodes` and `bytes`, by kind.

    Raises:
        XrgsError: fewer than 5 cells, or a command failed; the message is what it printed.
    """
    seeds = cells // (len(_LABELS) + 1)
    if seeds < 1:
        raise XrgsError(f"store_cells={cells}: must be at least {len(_LABELS) + 1}")
    axes = (f"+ablation={','.join(_LABELS)}", f"seed=range(0,{seeds})", *_CELL)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        _run(folder, "sweep", *_CELL)
        template = next((folder / "store" / "cells").iterdir())
        plan, first = _run(folder, "sweep", *axes, "dry_run=true")
        wanted = _LINE.findall(plan)
        for cell_id, seed in wanted:
            _copy(template, template.with_name(cell_id), int(seed))
        timed = {"plan, nothing done": first}
        for what, command in {
            "plan, all done": ("sweep", *axes, "dry_run=true"),
            "sweep, all done: plan, record and report": ("sweep", *axes),
            "report": ("report", "store=store"),
            "status": ("status", "store=store"),
        }.items():
            _, timed[what] = _run(folder, *command)
        count = len(wanted)
        rows = [
            {
                "command": what,
                "seconds": wall,
                "cpu_seconds": cpu,
                "ms_per_cell": 1000 * cpu / count,
            }
            for what, (wall, cpu) in timed.items()
        ]
        return {"cells": count, "commands": rows} | _cost(template)


def _cost(cell: Path) -> dict[str, Any]:
    """What a cell takes of the store, by kind; renders and splats depend on the scene alone."""
    files = [file for file in cell.rglob("*") if file.is_file()]
    sizes = dict.fromkeys(("renders", "splats", "the rest"), 0)
    for file in files:
        sizes[_LINKED.get(file.suffix, "the rest")] += file.stat().st_size
    folders = 1 + sum(entry.is_dir() for entry in cell.rglob("*"))
    return {"files": len(files), "inodes": len(files) + folders, "bytes": sizes}


def _run(folder: Path, command: str, *arguments: str) -> tuple[str, tuple[float, float]]:
    """What `xrgs-<command>` said on stderr, and what it took: seconds, and seconds of CPU."""
    script = f"from xrgs.cli.{command} import main; main()"
    start, before = time.perf_counter(), _cpu_seconds()
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-P", "-c", script, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    took = time.perf_counter() - start, _cpu_seconds() - before
    if done.returncode:
        raise XrgsError(f"xrgs-{command} {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stderr, took


def _cpu_seconds() -> float:
    """Of every child that has ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _copy(template: Path, cell: Path, seed: int) -> None:
    """A finished cell like the template, with another seed."""
    if cell == template:
        return
    status = json.loads((template / "status.json").read_text(encoding="utf-8"))
    for name in (*status["files"], "log.txt"):
        file = cell / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix in _LINKED:
            os.link(template / name, file)
            continue
        content = (template / name).read_bytes()
        if name == "identity.json":
            content = json.dumps(json.loads(content) | {"seed": seed}).encode()
            digest = hashlib.sha256(content).hexdigest()
            status["files"][name] = {"bytes": len(content), "sha256": digest}
        file.write_bytes(content)
    (cell / "status.json").write_text(json.dumps(status), encoding="utf-8")


def text(found: dict[str, Any]) -> str:
    """What was measured, as a table."""
    return "\n".join(_lines(found))


def _lines(found: dict[str, Any]) -> Iterator[str]:
    sizes = ", ".join(f"{kind} {size}" for kind, size in found["bytes"].items())
    yield f"{found['cells']} cells; one is {found['files']} files, {found['inodes']} inodes"
    yield f"bytes of a cell: {sum(found['bytes'].values())} ({sizes})"
    yield f"{'':<42} {'seconds':>8} {'of CPU':>8} {'ms a cell':>10}"
    for row in found["commands"]:
        yield (
            f"{row['command']:<42} {row['seconds']:>8.2f} {row['cpu_seconds']:>8.2f} "
            f"{row['ms_per_cell']:>10.2f}"
        )
