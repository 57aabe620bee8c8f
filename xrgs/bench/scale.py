"""How long planning, reporting and looking take over a store of many finished cells.

The commands are run as a user runs them. One cell is trained; the others are copies of it, under
the ids that a plan asks for and with their own seed, their pictures and splats as links to its.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
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
_LINKED = {".ply", ".png"}


def measure(cells: int, out: Path) -> list[dict[str, Any]]:
    """Time each command over so many cells.

    Args:
        cells: how many, the multiple of 5 below it: of a baseline and four ablations each.
        out: folder in which the store is made, and cleared away again.

    Returns:
        Rows of `command`, `seconds` and `ms_per_cell`.

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
        bookkeeping = sum(f.stat().st_size for f in template.glob("*.json"))
        # `kept` is what a cell costs beside its results.
        return [
            {
                "command": what,
                "cells": len(wanted),
                "seconds": seconds,
                "ms_per_cell": 1000 * seconds / len(wanted),
                "kept_bytes_per_cell": bookkeeping,
            }
            for what, seconds in timed.items()
        ]


def _run(folder: Path, command: str, *arguments: str) -> tuple[str, float]:
    """What `xrgs-<command>` said on stderr, and how long it took from start to end."""
    script = f"from xrgs.cli import {command}; {command}()"
    start = time.perf_counter()
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-P", "-c", script, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - start
    if done.returncode:
        raise XrgsError(f"xrgs-{command} {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stderr, seconds


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


def text(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    return "\n".join(_lines(rows))


def _lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield f"{rows[0]['cells']} cells, each with {rows[0]['kept_bytes_per_cell']} bytes of JSON"
    yield f"{'':<42} {'seconds':>8} {'ms a cell':>10}"
    for row in rows:
        yield f"{row['command']:<42} {row['seconds']:>8.2f} {row['ms_per_cell']:>10.2f}"
