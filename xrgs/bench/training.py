"""Loss, optimizer and the whole training step: where its time goes, against the alternatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from xrgs.bench.loads import Load
from xrgs.bench.timing import Times, alternate, threads
from xrgs.splat.densify import Densifier
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rasterize import rasterize
from xrgs.splat.resample import resize
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings

L1, SSIM = 0.8, 0.2
PARTS = ("render", "loss", "backward", "optimizer", "densify")


def time_losses(
    sizes: Sequence[tuple[int, int]], backends: Sequence[str], counts: Sequence[int], repeats: int
) -> list[Any]:
    """Value and gradient of the photometric loss at each (width, height), against kornia's SSIM."""
    rows = []
    for width, height in sizes:
        generator = torch.Generator().manual_seed(0)
        image, photograph = torch.rand(2, height, width, 3, generator=generator)
        image.requires_grad_()
        things: dict[str, Callable[[], object]] = {}
        for count in counts:
            for backend in backends:
                things[f"{backend}/{count}"] = _our_loss(image, photograph, backend, count)
            things[f"kornia/{count}"] = _kornias_loss(image, photograph, count)
        times = alternate(things, repeats)
        rows += [
            _named(name, time) | {"width": width, "height": height} for name, time in times.items()
        ]
    return rows


def _our_loss(image: Tensor, photograph: Tensor, backend: str, count: int) -> Callable[[], object]:
    target = prepare_target(photograph)  # once a view

    def run() -> object:
        with threads(count):
            loss = photometric_loss(image, target, l1=L1, ssim=SSIM, backend=backend)
            return torch.autograd.grad(loss, image)

    return run


def _kornias_loss(image: Tensor, photograph: Tensor, count: int) -> Callable[[], object]:
    from kornia.losses import ssim_loss

    reference = photograph.permute(2, 0, 1)[None]

    def run() -> object:
        with threads(count):
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
    """An LR view brought up to (width, height), as the consistency loss does, and its gradient.

    `interpolate` is torch's own function, of the same values.
    """
    width, height = size
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(height // factor, width // factor, 3, generator=generator)
    slope = torch.rand(height, width, 3, generator=generator)
    image.requires_grad_()

    def ours(backend: str, count: int) -> object:
        with threads(count):
            resized = resize(image, height, width, backend=backend)
            return torch.autograd.grad(resized, image, slope)

    def torchs(count: int) -> object:
        with threads(count):
            planes = image.permute(2, 0, 1)[None]
            resized = interpolate(planes, (height, width), mode="bicubic", antialias=True)
            return torch.autograd.grad(resized, image, slope.permute(2, 0, 1)[None])

    things: dict[str, Callable[[], object]] = {}
    for count in counts:
        things |= {f"{backend}/{count}": partial(ours, backend, count) for backend in backends}
        things[f"interpolate/{count}"] = partial(torchs, count)
    times = alternate(things, repeats)
    return [
        _named(name, time) | {"width": width, "height": height, "factor": factor}
        for name, time in times.items()
    ]


def time_optimizers(
    sizes: Sequence[int], backends: Sequence[str], counts: Sequence[int], repeats: int
) -> list[Any]:
    """A step of Adam over all parameters of so many Gaussians.

    `torch` is torch's fused step, one optimizer with six groups; `default` is torch.optim.Adam as
    it comes.
    """
    rows = []
    for size in sizes:
        things: dict[str, Callable[[], object]] = {}
        for count in counts:
            for kind in (*backends, "default"):
                things[f"{kind}/{count}"] = _optimizer_step(size, kind, count)
        times = alternate(things, repeats)
        rows += [_named(name, time) | {"gaussians": size} for name, time in times.items()]
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
        with threads(count):
            optimizer.step()

    return run


def _optimizer(gaussians: Gaussians, backend: str) -> SplatOptimizer:
    return SplatOptimizer(
        gaussians, OptimizerSettings(), scene_scale=1.0, steps=30_000, backend=backend
    )


def _named(name: str, times: Times) -> dict[str, Any]:
    kind, _, count = name.partition("/")
    return {"kind": kind, "threads": int(count), "ms": times.least, "median_ms": times.median}


class Step:
    """The parts of a training step on a load, in the order of `PARTS`.

    The photograph is the load's own render, and the Gaussians stay as many as they are: nothing
    reaches the thresholds of densification, whose bookkeeping is timed all the same.
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
        self.densifier = Densifier(
            self.optimizer, self.settings, scene_scale=1.0, generator=torch.Generator()
        )
        self.render()
        self.target = prepare_target(self.rendered.image.detach() + 0.01)

    def render(self) -> None:
        """Activation and the forward pass."""
        with threads(self.threads):
            self.optimizer.zero_grad()
            self.offset = torch.zeros(len(self.gaussians), 2, requires_grad=True)
            self.rendered = rasterize(
                *self.gaussians.activated(),
                self.camera,
                RasterSettings(),
                sh_degree=self.sh_degree,
                means2d_offset=self.offset,
                backend=self.backend,
            )

    def loss(self) -> None:
        """Its value, and natively its gradient too."""
        with threads(self.threads):
            self.value = photometric_loss(
                self.rendered.image, self.target, l1=L1, ssim=SSIM, backend=self.backend
            )

    def backward(self) -> None:
        """To the raw parameters."""
        with threads(self.threads):
            torch.autograd.backward(self.value)

    def optimize(self) -> None:
        """One step of Adam."""
        with threads(self.threads):
            self.optimizer.step(self.camera, sh_degree=self.sh_degree)

    def densify(self) -> None:
        """All steps from one refinement to the next."""
        for step in range(1, self.settings.every + 1):
            self._after_step(step)

    def all(self) -> None:
        """One whole step, its share of densification's bookkeeping included."""
        for part in (self.render, self.loss, self.backward, self.optimize):
            part()
        self._after_step(1)

    def _after_step(self, step: int) -> None:
        camera = self.camera
        with threads(self.threads):
            self.densifier.after_step(
                step,
                self.offset.grad,
                self.rendered.visible,
                width=camera.width,
                height=camera.height,
            )

    def counted_bytes(self) -> int:
        """Parameters, gradients, Adam's state and the renderer's buffers, as training counts."""
        model = [self.gaussians[name] for name in PARAMETERS]
        gradients = [value.grad for value in model if value.grad is not None]
        held = sum(value.nbytes for value in model + gradients)
        return held + self.optimizer.state_bytes() + self.rendered.buffer_bytes

    def parts(self) -> list[Callable[[], None]]:
        """One for each of `PARTS`."""
        return [self.render, self.loss, self.backward, self.optimize, self.densify]


def time_steps(
    loads: dict[str, Load], backend: str, counts: Sequence[int], repeats: int
) -> list[Any]:
    """Milliseconds of each part of a step for each load and number of threads."""
    steps = {
        f"{name}/{count}": Step(load, backend, count)
        for name, load in loads.items()
        for count in counts
    }
    things = {
        f"{name}/{part}": run
        for name, step in steps.items()
        for part, run in zip(PARTS, step.parts(), strict=True)
    }
    times = alternate(things, repeats)
    rows = []
    for name, step in steps.items():
        view, _, count = name.partition("/")
        parts = {part: times[f"{name}/{part}"].least for part in PARTS}
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
