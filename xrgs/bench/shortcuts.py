"""Measures each shortcut: work that is left out since a scene doesn't need it.

Each shortcut is timed on and off; on is how the program runs. Approximations, which do change the
numbers, are measured by `xrgs.bench.quality`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from xrgs.bench.loads import Load
from xrgs.bench.rendering import RenderMethod, RenderTask, errors, time_methods
from xrgs.bench.timing import time_interleaved, use_threads
from xrgs.bench.training import L1, SSIM, TrainingStep
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.settings import CullingOptions
from xrgs.splat.sh import bases

INACTIVE_BANDS = "inactive SH bands"
_SIDE_KEYS = ("forward_ms", "backward_ms", "evaluations")


def time_renders(load: Load, backend: str, repeats: int) -> list[Any]:
    """Time rendering forward and backward on one thread, with each shortcut on and off in turn.

    The kinds of culling (`CullingOptions`) are the native backend's. Both backends leave out the
    spherical-harmonics bands above the degree that training has reached.

    Args:
        load: What is rendered.
        backend: "native" or "torch".
        repeats: Number of timed runs.

    Returns:
        A row for each shortcut: `shortcut`, `load`, sizes, `times` (off over on), `same_bits`
        (whether image and gradients are equal) and, under `on` and `off`, times in ms, alpha
        evaluations and errors against float64.
    """
    usual = RenderMethod("on", backend)
    rows = []
    if backend == "native":
        without = {
            field.name.replace("_", " "): replace(
                usual, name=field.name, culling=replace(CullingOptions(), **{field.name: False})
            )
            for field in fields(CullingOptions)
        }
        rows += _rows(load, usual, without, repeats)
    degree_0 = replace(
        load, sh=torch.cat([load.sh[:, :1], torch.zeros_like(load.sh[:, 1:])], dim=1)
    )
    first = replace(usual, sh_degree=0)
    return rows + _rows(
        degree_0, first, {INACTIVE_BANDS: replace(usual, name=INACTIVE_BANDS)}, repeats
    )


def _rows(
    load: Load, usual: RenderMethod, without: dict[str, RenderMethod], repeats: int
) -> list[Any]:
    chosen = [usual, *without.values()]
    timed, error = time_methods(load, chosen, [1], repeats), errors(load, chosen)
    rest = bases(usual.sh_degree) - 1
    expected = _results(load, usual, rest)
    rows = []
    for shortcut, method in without.items():
        sides = {}
        for side, used in (("on", usual), ("off", method)):
            row = timed[used.name, 1]
            sides[side] = {key: row[key] for key in _SIDE_KEYS} | error[used.name]
        rows.append(
            {
                "shortcut": shortcut,
                "load": load.name,
                "backend": usual.backend,
                "threads": 1,
                "gaussians": len(load),
                "width": load.camera.width,
                "height": load.camera.height,
                **sides,
                "times": _total_ms(sides["off"]) / _total_ms(sides["on"]),
                "same_bits": all(map(torch.equal, _results(load, method, rest), expected)),
            }
        )
    return rows


def _total_ms(side: dict[str, float]) -> float:
    return side["forward_ms"] + side["backward_ms"]


def _results(load: Load, method: RenderMethod, rest: int) -> list[Tensor]:
    """Return the image and the gradients; of shN's, those of the first `rest` coefficients."""
    rendering = RenderTask(load, method, 1)
    rendering.forward()
    *gradients, harmonics = rendering.backward()
    assert rendering.image is not None, "backward() was just called"  # noqa: S101
    return [rendering.image, *gradients, harmonics[:, :rest]]


def time_steps(load: Load, backend: str, repeats: int) -> list[Any]:
    """Time the shortcuts of a training step outside of the renderer, on one thread.

    None of them changes a bit.

    Args:
        load: What is rendered and trained.
        backend: "native" or "torch".
        repeats: Number of timed runs.

    Returns:
        A row for each shortcut: `shortcut`, the `part` of the step that it belongs to, sizes,
        `on_ms`, `off_ms` and `times` (off over on).
    """
    before, after = before_and_after_bands(load, backend)
    rows = []
    for shortcut, part, pair in (
        ("statistics of the photograph, once per view", "loss", _statistics(load, backend)),
        ("moments that are all zero", "optimizer", (before.optimize, after.optimize)),
    ):
        times = time_interleaved(dict(zip(("on", "off"), pair, strict=True)), repeats)
        rows.append(
            {
                "shortcut": shortcut,
                "part": part,
                "backend": backend,
                "threads": 1,
                "gaussians": len(load),
                "width": load.camera.width,
                "height": load.camera.height,
                "on_ms": times["on"].minimum,
                "off_ms": times["off"].minimum,
                "times": times["off"].minimum / times["on"].minimum,
            }
        )
    return rows


def _statistics(load: Load, backend: str) -> tuple[Callable[[], Tensor], Callable[[], Tensor]]:
    """Return two functions: the loss's gradient with the target prepared before, and in it."""
    generator = torch.Generator().manual_seed(0)
    shape = (2, load.camera.height, load.camera.width, 3)
    image, photograph = torch.rand(shape, generator=generator)
    image.requires_grad_()
    target = prepare_target(photograph)

    def run(*, prepared: bool) -> Tensor:
        with use_threads(1):
            used = target if prepared else prepare_target(photograph)
            loss = photometric_loss(image, used, l1=L1, ssim=SSIM, backend=backend)
            gradient: Tensor = torch.autograd.grad(loss, image)[0]
            return gradient

    return partial(run, prepared=True), partial(run, prepared=False)


def before_and_after_bands(load: Load, backend: str) -> tuple[TrainingStep, TrainingStep]:
    """Return two training steps ready to optimize: at SH degree 0, and at degree 3.

    At degree 0 the moments of shN are all zero, which is what Adam's shortcut needs.

    Args:
        load: What is rendered and trained.
        backend: "native" or "torch".
    """
    before, after = (TrainingStep(load, backend, 1, sh_degree=degree) for degree in (0, 3))
    for step in (before, after):
        step.loss()
        step.backward()
    return before, after
