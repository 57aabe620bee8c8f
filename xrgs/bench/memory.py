"""Measures the memory of a training step: the bytes counted, and by how much a process grows.

A process of its own is measured (`python -m xrgs.bench.memory`), since the benchmark's process has
held other loads before.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from xrgs.safeio.untrusted import parse_json

_STEPS = 3  # in the first one, the optimizer has no state yet
_PROCESS_STATUS = Path("/proc/self/status")


def measure(
    gaussians: int, width: int, height: int, backend: str, threads: int, seed: int
) -> dict[str, Any]:
    """Train a random load for a few steps in a new process and measure its memory.

    Args:
        gaussians: Number of Gaussians.
        width: Width of the view, px.
        height: Height of the view, px.
        backend: "native" or "torch".
        threads: Number of threads.
        seed: Seed of the load.

    Returns:
        A row: the arguments but for the seed; `counted_bytes`, of parameters, gradients, Adam's
        state and the renderer's buffers; `base_rss_bytes`, the resident memory once everything is
        imported; `peak_rss_bytes`, its maximum later; and `growth_bytes`, their difference, which
        is what training took. The last three are None on a system without /proc.
    """
    arguments = [str(value) for value in (gaussians, width, height, backend, threads, seed)]
    # -P, as for xrgs.sweep.jobs.worker: the child must import the same package as its parent, and
    # not a checkout that happens to be the current folder.
    command = [sys.executable, "-P", "-m", "xrgs.bench.memory", *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)  # noqa: S603
    row: dict[str, Any] = parse_json(done.stdout)
    return row


def _resident() -> tuple[int, int] | None:
    """Return the resident memory in bytes, now and at its maximum so far; None without /proc."""
    if not _PROCESS_STATUS.exists():
        return None
    lines = dict(line.split(":", 1) for line in _PROCESS_STATUS.read_text("ascii").splitlines())
    current, peak = (1024 * int(lines[key].split()[0]) for key in ("VmRSS", "VmHWM"))
    return current, peak


def _measure_this_process(arguments: list[str]) -> dict[str, Any]:
    from xrgs.bench import loads, training

    backend = arguments.pop(3)
    gaussians, width, height, threads, seed = map(int, arguments)
    # A tiny step first, so that libraries which are loaded on first use count as the base.
    _train(training.TrainingStep(loads.random_load(50, 16, 16, seed), backend, threads))
    before = _resident()
    step = training.TrainingStep(
        loads.random_load(gaussians, width, height, seed), backend, threads
    )
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
    """Train a few steps; return the bytes counted at the last one."""
    for _ in range(_STEPS):
        step.run_step()
    return int(step.counted_bytes())


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_measure_this_process(sys.argv[1:])))
