"""The process that runs one installation for `xrgs.bench.against`, under that one's interpreter.

Both installations run this file, by its path, so that both do the same work. It imports nothing of
the package beside what it measures, and looks for each of those under the names of every release:
an older installation has no `rasterize_parameters`, but `rasterize` with the same arguments.

It reads one line of JSON, {"scene": FILE, "views": {NAME: FILE}}: .npz files as
`xrgs.bench.loads.write` writes them, the scene to be rendered and the views to be trained on. It
answers with {"package": FOLDER, "isa": NAME}. Then it reads one {"task": NAME, "threads": COUNT} a
line, runs that task once, and answers with {"ms": DURATION}. It ends with its input.
"""

from __future__ import annotations

import importlib
import inspect
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

L1, SSIM = 0.8, 0.2  # weights of the photometric loss, as in xrgs.bench.training
SH_DEGREE = 3
_PARAMETERS = ("means", "quats", "scales", "opacities")


def _find(module: str, *names: str) -> Any:
    """Return the first of `names` that the module has: what it is called in one release or another.

    Raises:
        AttributeError: It has none of them.
    """
    found = importlib.import_module(module)
    for name in names:
        if hasattr(found, name):
            return getattr(found, name)
    raise AttributeError(f"{module} has none of {', '.join(names)}")


class Load:
    """Activated Gaussians and a camera, of a file."""

    def __init__(self, path: str) -> None:
        with np.load(path) as arrays:
            tensors = {key: torch.tensor(np.asarray(arrays[key])).float() for key in arrays.files}
        sh = tensors["sh"]
        self.parameters = [tensors[name] for name in _PARAMETERS]
        self.parameters += [sh[:, :1].contiguous(), sh[:, 1:].contiguous()]
        camera = _find("xrgs.splat.cameras", "Camera")
        width, height = int(tensors["width"]), int(tensors["height"])
        self.camera = camera(tensors["viewmat"], tensors["K"], width, height)


def render_task(load: Load) -> Callable[[], None]:
    """Return a function that renders a load forward and backward.

    Args:
        load: What is rendered.
    """
    rasterize = _find("xrgs.splat.rendering", "rasterize_parameters", "rasterize")
    settings = _find("xrgs.splat.settings", "RasterSettings")()
    leaves = [value.clone().requires_grad_() for value in load.parameters]
    shape = (load.camera.height, load.camera.width, 3)
    image_grad = torch.randn(shape, generator=torch.Generator().manual_seed(0))

    def run() -> None:
        render = rasterize(*leaves, load.camera, settings, sh_degree=SH_DEGREE, backend="native")
        torch.autograd.grad(render.image, leaves, image_grad)

    return run


def step_task(load: Load) -> Callable[[], None]:
    """Return a function that takes one whole training step, and never adds or removes Gaussians.

    The step consists of activation, render, loss, backward pass, Adam and the statistics of
    densification. The target is the load's own render, slightly brighter.

    Args:
        load: What is trained.
    """
    rasterize = _find("xrgs.splat.rendering", "rasterize_parameters", "rasterize")
    settings = _find("xrgs.splat.settings", "RasterSettings")()
    loss = _find("xrgs.splat.loss", "photometric_loss")
    camera = load.camera
    means, quats, scales, opacities, sh0, rest = load.parameters
    raw = (means, quats, scales.clamp_min(1e-8).log(), opacities.clamp(1e-4, 1 - 1e-4).logit())
    leaves = [value.clone().requires_grad_() for value in (*raw, sh0, rest)]
    gaussians = _find("xrgs.splat.gaussians", "Gaussians")(*leaves)
    # As training activates them: an older installation has torch's functions alone.
    has_backend = "backend" in inspect.signature(gaussians.activated).parameters
    choice = {"backend": "native"} if has_backend else {}
    optimizer = _find("xrgs.splat.optimizer", "SplatOptimizer")(
        gaussians,
        _find("xrgs.splat.settings", "OptimizerSettings")(),
        scene_scale=1.0,
        steps=30_000,
        backend="native",
    )
    never = _find("xrgs.splat.settings", "DensifySettings")(
        start=0, grow_grad2d=math.inf, prune_opacity=0.0, prune_scale3d=math.inf
    )
    strategy = _find("xrgs.splat.strategy.default", "DefaultStrategy")(
        optimizer, never, scene_scale=1.0, generator=torch.Generator()
    )

    def render() -> tuple[Any, Tensor]:
        offset = torch.zeros(len(gaussians), 2, requires_grad=True)
        rendered = rasterize(
            *gaussians.activated(**choice),
            camera,
            settings,
            sh_degree=SH_DEGREE,
            means2d_offset=offset,
            backend="native",
        )
        return rendered, offset

    prepare = _find("xrgs.splat.loss", "prepare_target")
    target = prepare(render()[0].image.detach() + 0.01)

    def run() -> None:
        optimizer.zero_grad()
        rendered, offset = render()
        value = loss(rendered.image, target, l1=L1, ssim=SSIM, backend="native")
        torch.autograd.backward(value)
        optimizer.step(camera, sh_degree=SH_DEGREE)
        # Step 1 gathers statistics; only every hundredth or so refines.
        size = {"width": camera.width, "height": camera.height}
        strategy.after_step(1, offset.grad, rendered.visible, **size)

    return run


def main() -> None:
    """Answer the requests of standard input, one line each, until it ends."""
    setup = json.loads(sys.stdin.readline())
    tasks = {"render": render_task(Load(setup["scene"]))}
    tasks |= {name: step_task(Load(path)) for name, path in setup["views"].items()}
    native = importlib.import_module("xrgs._native")
    _answer({"package": str(Path(str(native.__file__)).parent), "isa": native.isa()})
    for line in sys.stdin:
        request = json.loads(line)
        torch.set_num_threads(request["threads"])
        run = tasks[request["task"]]
        start = time.perf_counter()
        run()
        _answer({"ms": 1e3 * (time.perf_counter() - start)})


def _answer(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
