"""Measures a training step: the time of each part, two shortcuts, and the memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xrgs.bench.loads import Load, random_load
from xrgs.bench.timing import Row, time_interleaved
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import rasterize_parameters, zero_means2d_offset
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings
from xrgs.splat.strategy.default import DefaultStrategy

L1, SSIM = 0.8, 0.2  # weights of the photometric loss
STEP_PARTS = ("render", "loss", "backward", "optimizer", "densify")
_MEMORY_STEPS = 3  # in the first step the optimizer has no state yet
_PROCESS_STATUS = Path("/proc/self/status")
_SETTINGS = DensifySettings(
    start=0, grow_grad2d=math.inf, prune_opacity=0.0, prune_scale3d=math.inf
)


class TrainingStep:
    """A training step on a load, which runs as a whole or part by part.

    The target is the load's render, slightly brighter. Densification collects its statistics, but
    its thresholds are out of reach, so that the number of Gaussians does not change.
    """

    def __init__(self, load: Load, backend: str, *, sh_degree: int = 3) -> None:
        self.load, self.camera, self.backend = load, load.camera, backend
        self.sh_degree = sh_degree
        raw = load.gaussians._replace(
            scales=load.gaussians.scales.clamp_min(1e-8).log(),
            opacities=load.gaussians.opacities.clamp(1e-4, 1 - 1e-4).logit(),
        )
        self.gaussians = Gaussians(*(value.clone().requires_grad_() for value in raw))
        self.optimizer = SplatOptimizer(
            self.gaussians, OptimizerSettings(), scene_scale=1.0, steps=30_000, backend=backend
        )
        self.strategy = DefaultStrategy(
            self.optimizer, _SETTINGS, scene_scale=1.0, generator=torch.Generator()
        )
        self.render()
        self.target = prepare_target(self.rendered.image.detach() + 0.01, backend=backend)

    def render(self) -> None:
        """Render; the native backend also applies the activation functions."""
        self.optimizer.zero_grad()
        self.offset = zero_means2d_offset(len(self.gaussians))
        self.rendered = rasterize_parameters(
            *self.gaussians.raw(),
            self.camera,
            RasterSettings(),
            sh_degree=self.sh_degree,
            means2d_offset=self.offset,
            raw=True,
            backend=self.backend,
        )

    def loss(self) -> None:
        """Compute the loss; the native backend also computes its gradient."""
        self.value = photometric_loss(
            self.rendered.image, self.target, l1=L1, ssim=SSIM, backend=self.backend
        )

    def backward(self) -> None:
        """Backpropagate to the raw parameters."""
        torch.autograd.backward(self.value)

    def optimize(self) -> None:
        """Take one step of Adam."""
        self.optimizer.step(self.camera, sh_degree=self.sh_degree)

    def densify(self, steps: int = _SETTINGS.every) -> None:
        """Run densification as in steps without refinement."""
        size: dict[str, Any] = {"width": self.camera.width, "height": self.camera.height}
        for step in range(1, steps + 1):
            self.strategy.after_step(step, self.offset.grad, self.rendered.visible, **size)

    def run_step(self) -> None:
        """Run a whole step, without refinement."""
        for part in (self.render, self.loss, self.backward, self.optimize):
            part()
        self.densify(steps=1)

    def parts(self) -> list[Callable[[], None]]:
        """Return the functions of the parts, in the order of `STEP_PARTS`."""
        return [self.render, self.loss, self.backward, self.optimize, self.densify]

    def counted_bytes(self) -> int:
        """Return the bytes of parameters, gradients, Adam's state and the renderer's buffers."""
        model = [self.gaussians[name] for name in PARAMETERS]
        gradients = [value.grad for value in model if value.grad is not None]
        model_bytes = sum(value.nbytes for value in model + gradients)
        return model_bytes + self.optimizer.state_bytes() + self.rendered.buffer_bytes


def time_steps(
    views: Mapping[str, Load], backend: str, counts: Sequence[int], repeats: int
) -> list[Row]:
    """Time each part of a training step.

    Returns:
        A row for each view and number of threads: sizes, the time of each part and of the step
        (`step_ms`), and the `speedup` over one thread.
    """
    steps = {
        (view, count): TrainingStep(load, backend)
        for view, load in views.items()
        for count in counts
    }
    tasks = {
        (*key, part): (key[1], run)
        for key, step in steps.items()
        for part, run in zip(STEP_PARTS, step.parts(), strict=True)
    }
    times = time_interleaved(tasks, repeats)
    rows: list[Row] = []
    for (view, count), step in steps.items():
        ms = {part: min(times[view, count, part]) for part in STEP_PARTS}
        ms["densify"] /= _SETTINGS.every
        row: Row = {"view": view, "backend": backend, "threads": count, **step.load.sizes}
        row |= {f"{part}_ms": value for part, value in ms.items()} | {"step_ms": sum(ms.values())}
        first_row = next((other for other in rows if other["view"] == view), row)
        rows.append(row | {"speedup": first_row["step_ms"] / row["step_ms"]})
    return rows


def time_shortcuts(load: Load, backend: str, repeats: int) -> list[Row]:
    """Time the shortcuts of a training step outside the renderer, on one thread.

    They do not change a bit of the result.

    Returns:
        A row for each shortcut: `shortcut`, the `part` of the step, sizes, `on_ms`, `off_ms` and
        `times` (time off over time on).
    """
    pairs = {
        ("statistics of the photograph, once per view", "loss"): loss_gradients(load, backend),
        ("moments that are all zero", "optimizer"): tuple(
            step.optimize for step in steps_of_sh_degrees(load, backend)
        ),
    }
    rows = []
    for (shortcut, part), pair in pairs.items():
        sides = {side: (1, task) for side, task in zip(("on", "off"), pair, strict=True)}
        times = time_interleaved(sides, repeats)
        on, off = min(times["on"]), min(times["off"])
        row = {"shortcut": shortcut, **load.sizes, "backend": backend, "threads": 1}
        rows.append(row | {"part": part, "on_ms": on, "off_ms": off, "times": off / on})
    return rows


def loss_gradients(load: Load, backend: str) -> tuple[Callable[[], Tensor], ...]:
    """Return two functions for the loss's gradient: with a prepared target, and preparing it."""
    generator = torch.Generator().manual_seed(0)
    shape = (2, load.camera.height, load.camera.width, 3)
    image, photograph = torch.rand(shape, generator=generator)
    image.requires_grad_()
    target = prepare_target(photograph, backend=backend)

    def gradient(*, prepared: bool) -> Tensor:
        used = target if prepared else prepare_target(photograph, backend=backend)
        loss = photometric_loss(image, used, l1=L1, ssim=SSIM, backend=backend)
        v_image: Tensor = torch.autograd.grad(loss, image)[0]
        return v_image

    return partial(gradient, prepared=True), partial(gradient, prepared=False)


def steps_of_sh_degrees(load: Load, backend: str) -> tuple[TrainingStep, TrainingStep]:
    """Return training steps at SH degree 0 and at degree 3, ready for `optimize`.

    At degree 0 all moments of shN are zero, and Adam skips shN.
    """
    before, after = (TrainingStep(load, backend, sh_degree=degree) for degree in (0, 3))
    for step in (before, after):
        step.loss()
        step.backward()
    return before, after


def measure_memory(backend: str, gaussians: int, width: int, height: int, threads: int) -> Row:
    """Train a random load for a few steps in a new process and measure its memory.

    Returns:
        A row with the sizes and, in MiB: `counted_mib`, of parameters, gradients, Adam's state and
        the renderer's buffers; `base_rss_mib`, resident memory before training; `peak_rss_mib`, its
        maximum; and `growth_mib`, their difference. Without /proc there is only `counted_mib`.
    """
    # A new process, since this one has already allocated memory for other loads.
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        sizes = (gaussians, width, height)
        return pool.submit(_memory_of_this_process, backend, *sizes, threads).result()


def _memory_of_this_process(
    backend: str, gaussians: int, width: int, height: int, threads: int
) -> Row:
    torch.set_num_threads(threads)
    # A tiny step first, so that memory of lazily loaded libraries is part of the base.
    _train(TrainingStep(random_load(50, 16, 16, seed=0), backend))
    base, _ = _resident_mib()
    step = TrainingStep(random_load(gaussians, width, height, seed=0), backend)
    row: Row = {"backend": backend, "threads": threads, **step.load.sizes}
    row["counted_mib"] = _train(step) / 2**20
    _, peak = _resident_mib()
    if peak:
        row |= {"base_rss_mib": base, "peak_rss_mib": peak, "growth_mib": peak - base}
    return row


def _train(step: TrainingStep) -> int:
    """Train a few steps; return `counted_bytes` after the last step."""
    for _ in range(_MEMORY_STEPS):
        step.run_step()
    return step.counted_bytes()


def _resident_mib() -> tuple[float, float]:
    """Return this process's resident memory and its maximum, MiB; zeros without /proc."""
    # Not ru_maxrss, which in a child process starts at the parent's value.
    if not _PROCESS_STATUS.exists():
        return 0.0, 0.0
    lines = dict(line.split(":", 1) for line in _PROCESS_STATUS.read_text("ascii").splitlines())
    current, peak = (int(lines[key].split()[0]) / 1024 for key in ("VmRSS", "VmHWM"))
    return current, peak
