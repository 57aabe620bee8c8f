"""Measures planning, reporting and status over a store of many cells, and the cost of a job.

The commands are run as a user runs them. One cell is trained. The others are copies of it, under
the ids that a plan gives and with their own seeds; their renders and splats are hard links.
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
from statistics import median
from typing import TYPE_CHECKING, Any

from xrgs import composing
from xrgs.capture import variant
from xrgs.capture.scenes import motorcycle
from xrgs.errors import XrgsError
from xrgs.experiment.cell_folder import CellFolder
from xrgs.safeio.records import read_object
from xrgs.safeio.untrusted import parse_json
from xrgs.sweep.session import HandOver, SweepSession

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_LABELS = ("loss_weighting", "gradient_scaling", "curriculum", "consistency")
_CELL = ("scene=motorcycle", "preset=smoke", "train.steps=2", "store=store")
_LINE = re.compile(r"^  \w+ +([0-9a-f]{16}) .*/ seed (\d+)$", re.MULTILINE)
_LINKED = {".png": "renders", ".ply": "splats"}
#: Photographs of the scene whose hashing is measured, and times that a job's cost is measured.
_PHOTOGRAPHS, _REPEATS = 100, 9


def measure(cells: int, out: Path) -> dict[str, Any]:
    """Measure each command over a store of many cells, and what a job costs before it trains.

    Args:
        cells: Number of cells, rounded down to a multiple of 5: a baseline and four ablations each.
        out: Folder in which the store is made, and removed at the end.

    Returns:
        `cells`, their number; `commands`, rows of `command`, `seconds`, `cpu_seconds` (of the
        command and all its children) and `ms_per_cell`; `job`, see `_job_cost`; and for one cell
        `files`, `inodes` and `bytes` by kind.

    Raises:
        XrgsError: There are fewer than 5 cells, or a command failed; the message has its output.
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
        planned = _LINE.findall(plan)
        for cell_id, seed in planned:
            _copy(template, template.with_name(cell_id), int(seed))
        times = {"plan, nothing done": first} | _time_commands(folder, axes)
        count = len(planned)
        rows = [
            {
                "command": what,
                "seconds": wall,
                "cpu_seconds": cpu,
                "ms_per_cell": 1000 * cpu / count,
            }
            for what, (wall, cpu) in times.items()
        ]
        job = _job_cost(template, folder)
        return {"cells": count, "commands": rows, "job": job} | _storage(template)


def _time_commands(folder: Path, axes: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Return the seconds and CPU seconds of each command over a store whose cells are all done."""
    commands = {
        "plan, all done": ("sweep", *axes, "dry_run=true"),
        "sweep, all done: plan, record and report": ("sweep", *axes),
        "report": ("report", "--store", "store"),
        "status": ("status", "--store", "store"),
    }
    return {what: _run(folder, *command)[1] for what, command in commands.items()}


def _job_cost(template: Path, folder: Path) -> dict[str, float]:
    """Return the ms of what a job does before it trains, and of what only the plan does.

    A job reads and verifies its cell's config and identity, and hashes the training code. The plan
    hashes every photograph of a scene, once for all of its cells.
    """
    cell = CellFolder(template)
    conf, _ = composing.from_file(template / "config.json")
    photographs = folder / "photographs"
    photographs.mkdir()
    content = motorcycle.files()["motorcycle_left"].read_bytes()
    for number in range(_PHOTOGRAPHS):
        (photographs / f"{number}.png").write_bytes(content)
    conf.scene.kind, conf.scene.path = "folder", str(photographs)
    (folder / "session").mkdir()
    session = SweepSession(folder / "session")
    session.begin()
    config_values = read_object(template / "config.json")
    hand_over = HandOver("cell", config_values, cell.identity())
    session.hand_over(hand_over)
    works: dict[str, Callable[[], object]] = {
        "job: read and verify the hand-over": lambda: session.read(cell.id).check_code(),
        "plan: write the hand-over": lambda: session.hand_over(hand_over),
        f"plan: hash {_PHOTOGRAPHS} photographs, once": lambda: variant.key(
            conf.scene, conf.variant
        ),
    }
    return {what: 1000 * _median_seconds(work) for what, work in works.items()}


def _median_seconds(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return median(seconds)


def _storage(cell: Path) -> dict[str, Any]:
    """Return the files and bytes of a cell; renders and splats depend on the scene alone."""
    files = [file for file in cell.rglob("*") if file.is_file()]
    sizes = dict.fromkeys(("renders", "splats", "the rest"), 0)
    for file in files:
        sizes[_LINKED.get(file.suffix, "the rest")] += file.stat().st_size
    folders = 1 + sum(entry.is_dir() for entry in cell.rglob("*"))
    return {"files": len(files), "inodes": len(files) + folders, "bytes": sizes}


def _run(folder: Path, command: str, *arguments: str) -> tuple[str, tuple[float, float]]:
    """Run `xrgs-<command>`; return its stderr, and the seconds and CPU seconds that it took."""
    script = f"from xrgs.cli.{command} import main; main()"
    start, before = time.perf_counter(), _cpu_seconds()
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-P", "-c", script, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - start, _cpu_seconds() - before
    if done.returncode:
        raise XrgsError(f"xrgs-{command} {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stderr, seconds


def _cpu_seconds() -> float:
    """Return the CPU seconds of all children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _copy(template: Path, cell: Path, seed: int) -> None:
    """Copy a finished cell under another id and seed."""
    if cell == template:
        return
    status = read_object(template / "status.json")
    for name in (*status["files"], "log.txt"):
        file = cell / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix in _LINKED:
            os.link(template / name, file)
            continue
        content = (template / name).read_bytes()
        if name == "identity.json":
            content = json.dumps(parse_json(content) | {"seed": seed}).encode()
            digest = hashlib.sha256(content).hexdigest()
            status["files"][name] = {"bytes": len(content), "sha256": digest}
        file.write_bytes(content)
    (cell / "status.json").write_text(json.dumps(status), encoding="utf-8")


def text(result: dict[str, Any]) -> str:
    """Return what was measured as a table.

    Args:
        result: What `measure` returned.
    """
    return "\n".join(_lines(result))


def _lines(result: dict[str, Any]) -> Iterator[str]:
    sizes = ", ".join(f"{kind} {size}" for kind, size in result["bytes"].items())
    yield f"{result['cells']} cells; one is {result['files']} files, {result['inodes']} inodes"
    yield f"bytes of a cell: {sum(result['bytes'].values())} ({sizes})"
    yield f"{'':<42} {'seconds':>8} {'of CPU':>8} {'ms a cell':>10}"
    for row in result["commands"]:
        yield (
            f"{row['command']:<42} {row['seconds']:>8.2f} {row['cpu_seconds']:>8.2f} "
            f"{row['ms_per_cell']:>10.2f}"
        )
    yield f"{'before a job trains':<42} {'ms':>8}"
    for what, milliseconds in result["job"].items():
        yield f"{what:<42} {milliseconds:>8.2f}"
