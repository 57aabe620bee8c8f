"""Measures planning, reporting and status over a store of many finished cells.

    python benchmarks/store.py 10000

One cell is trained. The others are its copies under the ids of a plan, with other seeds; all files
except `identity.json` and `status.json` are hard links. Then the commands run as for a user, in a
temporary folder below the current one.
"""

from __future__ import annotations

import argparse
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

LABELS = ("loss_weighting", "gradient_scaling", "curriculum", "consistency")
CELL = ("scene=motorcycle", "preset=smoke", "train.steps=2", "store=store")
PLANNED_CELL = re.compile(r"^  \w+ +([0-9a-f]{16}) .*/ seed (\d+)$", re.MULTILINE)


def main() -> None:
    """Parse the command line, measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("cells", type=int, help="number of cells, a multiple of 5")
    cells = parser.parse_args().cells
    if cells < 5 or cells % 5:  # a baseline and four ablations of each seed
        parser.error(f"cells must be a multiple of 5, got {cells}")
    with tempfile.TemporaryDirectory(dir=".") as folder:
        rows = measure(Path(folder), cells)
    lines = [f"{'':<42} {'seconds':>8} {'of CPU':>8} {'ms a cell':>10}"]
    for command, (seconds, cpu_seconds) in rows.items():
        ms = 1000 * cpu_seconds / cells
        lines.append(f"{command:<42} {seconds:>8.2f} {cpu_seconds:>8.2f} {ms:>10.2f}")
    sys.stdout.write("\n".join(lines) + "\n")


def measure(folder: Path, cells: int) -> dict[str, tuple[float, float]]:
    """Return command -> (seconds, CPU seconds), over a store of this many cells."""
    axes = (f"+ablation={','.join(LABELS)}", f"seed=range(0,{cells // 5})", *CELL)
    run(folder, "sweep", *CELL)
    template = next((folder / "store" / "cells").iterdir())
    plan, *first = run(folder, "sweep", *axes, "dry_run=true")
    planned = PLANNED_CELL.findall(plan)
    if len(planned) != cells:
        raise SystemExit(f"the plan must have {cells} cells:\n{plan}")
    for cell_id, seed in planned:
        if cell_id != template.name:
            copy(template, template.with_name(cell_id), int(seed))
    plan, *second = run(folder, "sweep", *axes, "dry_run=true")
    if f"{cells} cells, {cells} done" not in plan:
        raise SystemExit(f"the copies must count as done:\n{plan}")
    return {
        "plan, nothing done": (first[0], first[1]),
        "plan, all done": (second[0], second[1]),
        "sweep, all done: plan, record and report": run(folder, "sweep", *axes)[1:],
        "report": run(folder, "report", "--store=store")[1:],
        "status": run(folder, "status", "--store=store")[1:],
    }


def copy(template: Path, cell: Path, seed: int) -> None:
    """Copy a finished cell under another id and seed."""
    status = json.loads((template / "status.json").read_text())
    identity = json.loads((template / "identity.json").read_text()) | {"seed": seed}
    content = json.dumps(identity).encode()
    digest = hashlib.sha256(content).hexdigest()
    status["files"]["identity.json"] = {"bytes": len(content), "sha256": digest}
    (cell / "renders").mkdir(parents=True)
    (cell / "identity.json").write_bytes(content)
    for name in (*status["files"], "log.txt"):
        if name != "identity.json":
            os.link(template / name, cell / name)
    (cell / "status.json").write_text(json.dumps(status))


def run(folder: Path, command: str, *arguments: str) -> tuple[str, float, float]:
    """Run `xrgs-<command>`; return its stderr, seconds and CPU seconds."""
    script = f"from xrgs.cli.{command} import main; main()"
    start, before = time.perf_counter(), cpu_seconds()
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-P", "-c", script, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"xrgs-{command} {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stderr, time.perf_counter() - start, cpu_seconds() - before


def cpu_seconds() -> float:
    """Return the CPU seconds of all ended child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
