"""What a training step takes of memory: the bytes counted, and by how much a process grows.

A process of its own, since the benchmark's has held other loads: `python -m xrgs.bench.memory`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

_STEPS = 3  # the first has no optimizer state yet
_STATUS = Path("/proc/self/status")


def measure(
    gaussians: int, width: int, height: int, backend: str, threads: int, seed: int
) -> dict[str, Any]:
    """A row of one load, trained for a few steps.

    Returns:
        `counted_bytes`: parameters, gradients, Adam's state and the renderer's buffers.
        `base_rss_bytes`: resident once all is imported. `peak_rss_bytes`: at its highest later.
        `growth_bytes`: the difference, which is what training took; these three are None where
        the system doesn't say (no /proc).
    """
    arguments = [str(value) for value in (gaussians, width, height, backend, threads, seed)]
    # -P: as xrgs.sweep.jobs.worker, the child must import the package that its parent did.
    command = [sys.executable, "-P", "-m", "xrgs.bench.memory", *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)  # noqa: S603
    row: dict[str, Any] = json.loads(done.stdout)
    return row


def _resident() -> tuple[int, int] | None:
    """Bytes resident now, and at their highest so far."""
    if not _STATUS.exists():
        return None
    lines = dict(line.split(":", 1) for line in _STATUS.read_text("ascii").splitlines())
    now, most = (1024 * int(lines[key].split()[0]) for key in ("VmRSS", "VmHWM"))
    return now, most


def _measured(arguments: list[str]) -> dict[str, Any]:
    from xrgs.bench import loads, training

    backend = arguments.pop(3)
    gaussians, width, height, threads, seed = map(int, arguments)
    # A step of next to nothing loads what is loaded late.
    _train(training.Step(loads.random_load(50, 16, 16, seed), backend, threads))
    before = _resident()
    step = training.Step(loads.random_load(gaussians, width, height, seed), backend, threads)
    counted = _train(step)
    after = _resident()
    base, peak = (None, None) if before is None or after is None else (before[0], after[1])
    return {
        "backend": backend,
        "threads": threads,
        "gaussians": gaussians,
        "width": width,
        "height": height,
        "counted_bytes": counted,
        "base_rss_bytes": base,
        "peak_rss_bytes": peak,
        "growth_bytes": None if peak is None or base is None else peak - base,
    }


def _train(step: Any) -> int:
    """Bytes counted at the last of a few steps."""
    for _ in range(_STEPS):
        step.all()
    return int(step.counted_bytes())


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_measured(sys.argv[1:])))
