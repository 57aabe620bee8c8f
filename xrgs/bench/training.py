"""Times the parts of a training step, and the loss and the optimizer against alternatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from xrgs.bench.loads import Load
from xrgs.bench.timing import Timings, time_interleaved, use_threads
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.resample import resize
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings
from xrgs.splat.strategy.default import DefaultStrategy

L1, SSIM = 0.8, 0.2  # weights of the photometric loss
#: Computes the loss; returns its gradient with respect to the image.
LossTask = Callable[[], tuple[Tensor, ...]]
STEP_PARTS = ("render", "loss", "backward", "optimizer", "densify")


def time_losses(
    sizes: Sequence[tuple[int, int]], backends: Sequence[str], counts: Sequence[int], repeats: int
) -> list[Any]:
    """Time the value and gradient of the photometric loss, against one made of kornia's SSIM.

    Args:
        sizes: Width and height of each image, px.
        backends: Names of the backends.
        counts: Numbers of threads.
        repeats: Number of timed runs.

    Returns:
        A row for each `kind` (a backend or "kornia"), number of threads and size.
    """
    rows = []
    for width, height in sizes:
        generator = torch.Generator().manual_seed(0)
        image, photograph = torch.rand(2, height, width, 3, generator=generator)
        image.requires_grad_()
        tasks: dict[str, Callable[[], object]] = {}
        for count in counts:
            for backend in backends:
                tasks[f"{backend}/{count}"] = _our_loss(image, photograph, backend, count)
            tasks[f"kornia/{count}"] = _kornia_loss(image, photograph, count)
        times = time_interleaved(tasks, repeats)
        rows += [
            _timing_row(name, time) | {"width": width, "height": height}
            for name, time in times.items()
        ]
    return rows


def _our_loss(image: Tensor, photograph: Tensor, backend: str, count: int) -> LossTask:
    target = prepare_target(photograph)  # once per view

    def run() -> tuple[Tensor, ...]:
        with use_threads(count):
            loss = photometric_loss(image, target, l1=L1, ssim=SSIM, backend=backend)
            return torch.autograd.grad(loss, image)

    return run


def _kornia_loss(image: Tensor, photograph: Tensor, count: int) -> LossTask:
    from kornia.losses import ssim_loss

    reference = photograph.permute(2, 0, 1)[None]

    def run() -> tuple[Tensor, ...]:
        with use_threads(count):
            # kornia's loss is (1 - SSIM) / 2.
            half = ssim_loss(image.permute(2, 0, 1)[None], reference, 11, padding="valid")
            loss = L1 * (image - photograph).abs().mean() + 2 * SSIM * half
            return torch.autograd.grad(loss, image)

    return run


def time_resizes(
    size: tuple[int, int],
    factor: int,
    backends: Sequence[str],
    counts: Sequence[int],
    repeats: int,
) -> list[Any]:
    """Time the upsampling of an LR view, as in the consistency loss, and its gradient.

    Args:
        size: Width and height of the result, px.
        factor: Ratio of the result's sides to the LR view's.
        backends: Names of the backends.
        counts: Numbers of threads.
        repeats: Number of timed runs.

    Returns:
        A row for each `kind` (a backend, or "interpolate", torch's function with the same values)
        and number of threads.
    """
    width, height = size
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(height // factor, width // factor, 3, generator=generator)
    resized_grad = torch.rand(height, width, 3, generator=generator)
    image.requires_grad_()

    tasks: dict[str, Callable[[], object]] = {}
    for count in counts:
        for backend in backends:
            tasks[f"{backend}/{count}"] = partial(_our_resize, image, resized_grad, backend, count)
        tasks[f"interpolate/{count}"] = partial(_torch_resize, image, resized_grad, count)
    times = time_interleaved(tasks, repeats)
    sizes = {"width": width, "height": height, "factor": factor}
    return [_timing_row(name, timings) | sizes for name, timings in times.items()]


def _our_resize(image: Tensor, resized_grad: Tensor, backend: str, count: int) -> object:
    height, width, _ = resized_grad.shape
    with use_threads(count):
        resized = resize(image, height, width, backend=backend)
        return torch.autograd.grad(resized, image, resized_grad)


def _torch_resize(image: Tensor, resized_grad: Tensor, count: int) -> object:
    with use_threads(count):
        planes = image.permute(2, 0, 1)[None]
        resized = interpolate(planes, resized_grad.shape[:2], mode="bicubic", antialias=True)
        return torch.autograd.grad(resized, image, resized_grad.permute(2, 0, 1)[None])


def time_optimizers(
    sizes: Sequence[int], backends: Sequence[str], counts: Sequence[int], repeats: int
) -> list[Any]:
    """Time a step of Adam over all parameters.

    Args:
        sizes: Numbers of Gaussians.
        backends: Names of the backends; "torch" is torch's fused Adam with six groups.
        counts: Numbers of threads.
        repeats: Number of timed runs.

    Returns:
        A row for each `kind` (a backend, or "default": torch.optim.Adam with its defaults), number
        of threads and size.
    """
    rows = []
    for size in sizes:
        tasks: dict[str, Callable[[], object]] = {}
        for count in counts:
            for kind in (*backends, "default"):
                tasks[f"{kind}/{count}"] = _optimizer_step(size, kind, count)
        times = time_interleaved(tasks, repeats)
        rows += [_timing_row(name, time) | {"gaussians": size} for name, time in times.items()]
    return rows


def _optimizer_step(size: int, kind: str, count: int) -> Callable[[], object]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
    shapes |= {"sh0": (1, 3), "shN": (15, 3)}
    values = {
        name: torch.randn(size, *shape, generator=generator) for name, shape in shapes.items()
    }
    gaussians = Gaussians(**{name: value.requires_grad_() for name, value in values.items()})
    backend = "torch" if kind == "default" else kind
    optimizer = _optimizer(gaussians, backend)
    if kind == "default":
        optimizer.adam = torch.optim.Adam(
            [{"params": [gaussians[name]], "lr": 1e-3} for name in PARAMETERS], eps=1e-15
        )
    for name in PARAMETERS:
        gaussians[name].grad = 1e-4 * torch.randn(gaussians[name].shape, generator=generator)

    def run() -> None:
        with use_threads(count):
            optimizer.step()

    return run


def _optimizer(gaussians: Gaussians, backend: str) -> SplatOptimizer:
    return SplatOptimizer(
        gaussians, OptimizerSettings(), scene_scale=1.0, steps=30_000, backend=backend
    )


def _timing_row(name: str, times: Timings) -> dict[str, Any]:
    kind, _, count = name.partition("/")
    return {"kind": kind, "threads": int(count), "ms": times.minimum, "median_ms": times.median}


class TrainingStep:
    """A training step on a load, whose parts can be run one by one, in the order of `STEP_PARTS`.

    The target is the load's own render, slightly brighter. The number of Gaussians stays the same:
    the densification thresholds are out of reach, but the statistics are gathered.
    """

    def __init__(self, load: Load, backend: str, count: int, *, sh_degree: int = 3) -> None:
        self.camera, self.backend, self.threads = load.camera, backend, count
        self.sh_degree = sh_degree
        means, quats, scales, opacities, sh0, rest = load.parameters
        raw = (
            means,
            quats,
            scales.clamp_min(1e-8).log(),
            opacities.clamp(1e-4, 1 - 1e-4).logit(),
            sh0,
            rest,
        )
        self.gaussians = Gaussians(*(value.clone().requires_grad_() for value in raw))
        self.optimizer = _optimizer(self.gaussians, backend)
        self.settings = DensifySettings(
            start=0, grow_grad2d=math.inf, prune_opacity=0.0, prune_scale3d=math.inf
        )
        self.strategy = DefaultStrategy(
            self.optimizer, self.settings, scene_scale=1.0, generator=torch.Generator()
        )
        self.render()
        self.target = prepare_target(self.rendered.image.detach() + 0.01)

    def render(self) -> None:
        """Activate the parameters and render."""
        with use_threads(self.threads):
            self.optimizer.zero_grad()
            self.offset = torch.zeros(len(self.gaussians), 2, requires_grad=True)
            self.rendered = rasterize_parameters(
                *self.gaussians.activated(backend=self.backend),
                self.camera,
                RasterSettings(),
                sh_degree=self.sh_degree,
                means2d_offset=self.offset,
                backend=self.backend,
            )

    def loss(self) -> None:
        """Compute the loss; the native backend computes its gradient as well."""
        with use_threads(self.threads):
            self.value = photometric_loss(
                self.rendered.image, self.target, l1=L1, ssim=SSIM, backend=self.backend
            )

    def backward(self) -> None:
        """Backpropagate to the raw parameters."""
        with use_threads(self.threads):
            torch.autograd.backward(self.value)

    def optimize(self) -> None:
        """Take one step of Adam."""
        with use_threads(self.threads):
            self.optimizer.step(self.camera, sh_degree=self.sh_degree)

    def densify(self) -> None:
        """Run densification's part of all steps from one refinement to the next."""
        for step in range(1, self.settings.every + 1):
            self._after_step(step)

    def run_step(self) -> None:
        """Run one whole step, including its part of densification."""
        for part in (self.render, self.loss, self.backward, self.optimize):
            part()
        self._after_step(1)

    def _after_step(self, step: int) -> None:
        camera = self.camera
        with use_threads(self.threads):
            self.strategy.after_step(
                step,
                self.offset.grad,
                self.rendered.visible,
                width=camera.width,
                height=camera.height,
            )

    def counted_bytes(self) -> int:
        """Return the bytes of parameters, gradients, Adam's state and the renderer's buffers.

        Training counts the same.
        """
        model = [self.gaussians[name] for name in PARAMETERS]
        gradients = [value.grad for value in model if value.grad is not None]
        model_bytes = sum(value.nbytes for value in model + gradients)
        return model_bytes + self.optimizer.state_bytes() + self.rendered.buffer_bytes

    def parts(self) -> list[Callable[[], None]]:
        """Return the functions of the parts, in the order of `STEP_PARTS`."""
        return [self.render, self.loss, self.backward, self.optimize, self.densify]


def time_steps(
    loads: dict[str, Load], backend: str, counts: Sequence[int], repeats: int
) -> list[Any]:
    """Time each part of a training step.

    Args:
        loads: The loads by the name of the view, "HR" or "LR".
        backend: "native" or "torch".
        counts: Numbers of threads.
        repeats: Number of timed runs.

    Returns:
        A row for each load and number of threads, with `parts_ms` and their sum `step_ms`.
    """
    steps = {
        f"{name}/{count}": TrainingStep(load, backend, count)
        for name, load in loads.items()
        for count in counts
    }
    tasks = {
        f"{name}/{part}": run
        for name, step in steps.items()
        for part, run in zip(STEP_PARTS, step.parts(), strict=True)
    }
    times = time_interleaved(tasks, repeats)
    rows = []
    for name, step in steps.items():
        view, _, count = name.partition("/")
        parts = {part: times[f"{name}/{part}"].minimum for part in STEP_PARTS}
        parts["densify"] /= step.settings.every
        rows.append(
            {
                "view": view,
                "backend": backend,
                "threads": int(count),
                "gaussians": len(step.gaussians),
                "width": step.camera.width,
                "height": step.camera.height,
                "parts_ms": parts,
                "step_ms": sum(parts.values()),
            }
        )
    return rows
