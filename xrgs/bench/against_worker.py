"""The process that runs the tasks of `xrgs.bench.against` in its own installation of xrgs.

Different versions must work together, so the module's name, the requests and the work of each task
never change. Requests and answers are lines of JSON on standard input and output:

- {"scene": FILE, "views": {NAME: FILE}}, with .npz files of `xrgs.bench.loads.write`. Answer:
  {"package": FOLDER, "isa": INSTRUCTION_SET}.
- {"task": "render" or NAME, "threads": COUNT}, to render the scene forward and backward, or take a
  training step on a view. Answer: {"ms": DURATION}.

The process exits at the end of its input.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import xrgs
from xrgs import _native
from xrgs.bench import loads
from xrgs.bench.rendering import RenderMethod, RenderTask
from xrgs.bench.training import TrainingStep


def main() -> None:
    """Answer the requests of standard input until it ends."""
    setup = json.loads(sys.stdin.readline())
    scene = RenderTask(loads.read(Path(setup["scene"])), RenderMethod("native", "native"))
    steps = {
        name: TrainingStep(loads.read(Path(file)), "native")
        for name, file in setup["views"].items()
    }
    tasks: dict[str, Callable[[], object]] = {"render": scene.results}
    tasks |= {name: step.run_step for name, step in steps.items()}
    _answer({"package": str(Path(str(xrgs.__file__)).parent), "isa": _native.isa()})
    for line in sys.stdin:
        request = json.loads(line)
        torch.set_num_threads(request["threads"])
        start = time.perf_counter()
        tasks[request["task"]]()
        _answer({"ms": 1e3 * (time.perf_counter() - start)})


def _answer(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
