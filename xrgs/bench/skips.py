"""Each thing that is left out because a scene doesn't need it: its time on and off, and its error.

`on` is the program as it is. A skip that changes no bit has no error of its own; what one that
does means for a trained scene is measured by `xrgs.bench.quality`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from xrgs.bench.loads import Load
from xrgs.bench.rendering import Rendering, Way, errors, time_ways
from xrgs.bench.timing import alternate, threads
from xrgs.bench.training import L1, SSIM, Step
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.settings import CullingOptions
from xrgs.splat.sh import bases

BANDS = "bands not on yet"
_KEPT = ("forward_ms", "backward_ms", "evaluations")


def time_renders(load: Load, backend: str, repeats: int) -> list[Any]:
    """Rendering forward and back on one thread, with each skip on and off in turn.

    Those of `CullingOptions` are the native backend's; the torch one has that of harmonics alone.

    Returns:
        A row each: `skip`, `load`, its sizes, `times` (off over on),
        `same_bits` (of image and gradients) and, under `on` and `off`, milliseconds, evaluations
        and errors against double precision.
    """
    usual = Way("on", backend)
    rows = []
    if backend == "native":
        without = {
            field.name.replace("_", " "): replace(
                usual, name=field.name, skips=replace(CullingOptions(), **{field.name: False})
            )
            for field in fields(CullingOptions)
        }
        rows += _rows(load, usual, without, repeats)
    bandless = replace(
        load, sh=torch.cat([load.sh[:, :1], torch.zeros_like(load.sh[:, 1:])], dim=1)
    )
    first = replace(usual, sh_degree=0)
    return rows + _rows(bandless, first, {BANDS: replace(usual, name=BANDS)}, repeats)


def _rows(load: Load, usual: Way, without: dict[str, Way], repeats: int) -> list[Any]:
    chosen = [usual, *without.values()]
    timed, error = time_ways(load, chosen, [1], repeats), errors(load, chosen)
    rest = bases(usual.sh_degree) - 1
    expected = _results(load, usual, rest)
    rows = []
    for skip, way in without.items():
        sides = {}
        for side, used in (("on", usual), ("off", way)):
            row = timed[used.name, 1]
            sides[side] = {key: row[key] for key in _KEPT} | error[used.name]
        rows.append(
            {
                "skip": skip,
                "load": load.name,
                "backend": usual.backend,
                "threads": 1,
                "gaussians": len(load),
                "width": load.camera.width,
                "height": load.camera.height,
                **sides,
                "times": _whole(sides["off"]) / _whole(sides["on"]),
                "same_bits": all(map(torch.equal, _results(load, way, rest), expected)),
            }
        )
    return rows


def _whole(side: dict[str, float]) -> float:
    return side["forward_ms"] + side["backward_ms"]


def _results(load: Load, way: Way, rest: int) -> list[Tensor]:
    """Image and gradients, of higher harmonics those of the first `rest`."""
    rendering = Rendering(load, way, 1)
    rendering.forward()
    *gradients, harmonics = rendering.backward()
    assert rendering.image is not None, "just rendered"  # noqa: S101 - a mistake of ours
    return [rendering.image, *gradients, harmonics[:, :rest]]


def time_steps(load: Load, backend: str, repeats: int) -> list[Any]:
    """What a training step leaves out besides, on one thread; none of it changes a bit.

    Returns:
        A row each: `skip`, the `part` of the step that it belongs to, sizes, `on_ms`, `off_ms` and
        `times` (off over on).
    """
    before, after = before_and_after_bands(load, backend)
    rows = []
    for skip, part, pair in (
        ("statistics of the photograph, once a view", "loss", _statistics(load, backend)),
        ("moments that are all zero", "optimizer", (before.optimize, after.optimize)),
    ):
        times = alternate(dict(zip(("on", "off"), pair, strict=True)), repeats)
        rows.append(
            {
                "skip": skip,
                "part": part,
                "backend": backend,
                "threads": 1,
                "gaussians": len(load),
                "width": load.camera.width,
                "height": load.camera.height,
                "on_ms": times["on"].least,
                "off_ms": times["off"].least,
                "times": times["off"].least / times["on"].least,
            }
        )
    return rows


def _statistics(load: Load, backend: str) -> tuple[Callable[[], Tensor], Callable[[], Tensor]]:
    """The loss's gradient with those of its photograph at hand, and with them computed for it."""
    generator = torch.Generator().manual_seed(0)
    shape = (2, load.camera.height, load.camera.width, 3)
    image, photograph = torch.rand(shape, generator=generator)
    image.requires_grad_()
    target = prepare_target(photograph)

    def run(*, prepared: bool) -> Tensor:
        with threads(1):
            known = target if prepared else prepare_target(photograph)
            loss = photometric_loss(image, known, l1=L1, ssim=SSIM, backend=backend)
            gradient: Tensor = torch.autograd.grad(loss, image)[0]
            return gradient

    return partial(run, prepared=True), partial(run, prepared=False)


def before_and_after_bands(load: Load, backend: str) -> tuple[Step, Step]:
    """Steps ready to optimize, before higher harmonics are on and once they are."""
    before, after = (Step(load, backend, 1, sh_degree=degree) for degree in (0, 3))
    for step in (before, after):
        step.loss()
        step.backward()
    return before, after
