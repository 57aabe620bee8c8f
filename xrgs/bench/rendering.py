"""Measures rendering: time and its growth, work, memory, error, and the effect of culling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.stats import linregress
from torch import Tensor

from xrgs.bench.loads import Load
from xrgs.bench.timing import Row, time_interleaved
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import Render, rasterize_parameters
from xrgs.splat.settings import CullingOptions, RasterSettings
from xrgs.splat.sh import bases

#: Width and height of the part of a view that is compared with a render in float64, px. A whole
#: large view would take minutes in float64.
ERROR_CROP = (96, 72)
#: Limits of a load for timing the torch backend, which is slow: Gaussians, pixels, repeats.
_TORCH_GAUSSIANS, _TORCH_PIXELS, _TORCH_REPEATS = 100_000, 504 * 378, 2
#: The stages of the native backend, forward and backward.
STAGES = (
    "project",
    "sort",
    "intersect_tiles",
    "composite",
    "composite_backward",
    "project_backward",
)
#: Name of the reference method for all errors.
TORCH_FLOAT64 = "torch float64"
INACTIVE_BANDS = "inactive SH bands"
ALL_LOADS = "all loads"


@dataclass(frozen=True)
class RenderMethod:
    """A backend with raster settings, some of which trade accuracy for time."""

    name: str
    backend: str
    settings: RasterSettings = field(default_factory=RasterSettings)
    sh_degree: int = 3
    culling: CullingOptions | None = None
    """Culling of the native backend; None means all kinds."""
    dtype: torch.dtype = torch.float32


def default_methods(backends: Sequence[str]) -> list[RenderMethod]:
    """Return all backends with gsplat's settings, torch in float64, the first with other cuts."""
    first, defaults = backends[0], RasterSettings()
    return [
        *(RenderMethod(name, name) for name in backends),
        RenderMethod(TORCH_FLOAT64, "torch", dtype=torch.float64),
        RenderMethod(f"{first}, alpha cut 4/255", first, replace(defaults, alpha_min=4 / 255)),
        RenderMethod(f"{first}, alpha cut 1/1020", first, replace(defaults, alpha_min=1 / 1020)),
        RenderMethod(f"{first}, stop at 1e-2", first, replace(defaults, transmittance_min=1e-2)),
    ]


class RenderTask:
    """Renders one load with one method, any number of times.

    Attributes:
        image: The last image, [H, W, 3], after a call of `backward`.
        work: Counts of the last render: `visible` Gaussians, alpha `evaluations`, and on the native
            backend (tile, Gaussian) `pairs`.
        buffer_bytes: Size of the buffers of the last render, bytes.
        stages: Stage -> its shortest time, ms; only on the native backend.
    """

    def __init__(self, load: Load, method: RenderMethod) -> None:
        self.camera, self.method = load.camera, method
        leaves = (value.to(method.dtype).clone().requires_grad_() for value in load.gaussians)
        self.leaves = ActivatedGaussians(*leaves)
        generator = torch.Generator().manual_seed(0)
        shape = (load.camera.height, load.camera.width, 3)
        self.image_grad = torch.randn(shape, generator=generator).to(method.dtype)  # dL/d(image)
        self.render: Render | None = None
        self.image = torch.empty(0)
        self.work: dict[str, int] = {}
        self.buffer_bytes = 0
        self.stages: dict[str, float] = {}

    def forward(self) -> None:
        """Render the load, and keep the autograd graph for `backward`."""
        view, degree = (self.camera, self.method.settings), self.method.sh_degree
        if self.method.culling is None:
            self.render = rasterize_parameters(
                *self.leaves, *view, sh_degree=degree, backend=self.method.backend
            )
        else:
            from xrgs.splat.native import rasterizer as native

            culling = self.method.culling
            self.render = native.render(self.leaves, *view, degree, None, culling=culling)

    def backward(self) -> tuple[Tensor, ...]:
        """Return the gradients of the six parameters for the last render, and free the graph."""
        render, self.render = self.render, None
        assert render is not None, "forward() must be called first"  # noqa: S101
        graph: Any = render.image.grad_fn
        gradients = torch.autograd.grad(render.image, self.leaves, self.image_grad)
        self.image = render.image.detach()
        self.work = {"visible": int(render.visible.sum()), "evaluations": render.evaluations}
        self.buffer_bytes = render.buffer_bytes
        if self.method.backend == "native":
            self.work["pairs"] = graph.frame.pair_count
            for stage, ms in graph.frame.timings.items():
                self.stages[stage] = min(ms, self.stages.get(stage, ms))
        return gradients

    def results(self) -> tuple[Tensor, ...]:
        """Render forward and backward; return the image and the six gradients."""
        self.forward()
        gradients = self.backward()
        return self.image, *gradients


def time_load(
    load: Load, methods: Sequence[RenderMethod], counts: Sequence[int], repeats: int
) -> list[Row]:
    """Time all methods on a load with each number of threads, and compute their errors.

    For large loads the torch backend is left out. For others it is timed at most twice, and its
    rows have `times_slower`, its time over that of the first native method.

    Returns:
        The rows of `time_methods`, with the columns of `errors` added.
    """
    fast = [method for method in methods if method.backend != "torch"]
    slow = [method for method in methods if method.backend == "torch"]
    rows = time_methods(load, fast, counts, repeats)
    if len(load) <= _TORCH_GAUSSIANS and load.camera.width * load.camera.height <= _TORCH_PIXELS:
        native_ms = {row["threads"]: total_ms(row) for row in reversed(rows)}  # the first method's
        for row in time_methods(load, slow, counts, min(repeats, _TORCH_REPEATS)):
            if fast:
                row["times_slower"] = total_ms(row) / native_ms[row["threads"]]
            rows.append(row)
    error = errors(load, methods)
    return [row | error[row["method"]] for row in rows]


def time_methods(
    load: Load, methods: Sequence[RenderMethod], counts: Sequence[int], repeats: int
) -> list[Row]:
    """Time each method with each number of threads, in turn.

    Returns:
        A row for each method and number of threads: sizes, shortest and median times (ms), speed-up
        over the first number of threads, work, and memory (MiB).
    """
    tasks = {(m.name, count): RenderTask(load, m) for m in methods for count in counts}
    passes: dict[tuple[str, int, str], tuple[int, Callable[[], object]]] = {}
    for key, task in tasks.items():
        passes[*key, "forward"] = key[1], task.forward
        passes[*key, "backward"] = key[1], task.backward
    times = time_interleaved(passes, repeats)
    rows: list[Row] = []
    for key, task in tasks.items():
        forward, backward = times[*key, "forward"], times[*key, "backward"]
        compositing = task.stages.get("composite", min(forward))
        parameter_bytes = sum(leaf.nbytes for leaf in task.leaves)
        row = {
            **load.sizes,
            "method": task.method.name,
            "backend": task.method.backend,
            "threads": key[1],
            "forward_ms": min(forward),
            "backward_ms": min(backward),
            "forward_median_ms": median(forward),
            "backward_median_ms": median(backward),
            **{f"{stage}_ms": ms for stage, ms in task.stages.items()},
            **task.work,
            "evaluations_per_s": 1e3 * task.work["evaluations"] / compositing,
            # Parameters and their gradients, and the buffers.
            "memory_mib": (2 * parameter_bytes + task.buffer_bytes) / 2**20,
        }
        first_row = next((other for other in rows if other["method"] == row["method"]), row)
        rows.append(row | {"speedup": total_ms(first_row) / total_ms(row)})
    return rows


def total_ms(row: Row) -> float:
    """Return the time of a render, forward plus backward, ms."""
    return float(row["forward_ms"] + row["backward_ms"])


def errors(load: Load, methods: Sequence[RenderMethod]) -> dict[str, dict[str, float]]:
    """Compare each method with the torch backend in float64 at gsplat's settings.

    Only the centre of the view (`ERROR_CROP`) is rendered. All methods must have the same
    `sh_degree`.

    Returns:
        Name of a method -> `image_mean_error` and `image_max_error`, absolute errors of the image,
        and `gradient_error`, the norm of a gradient's error over the norm of the gradient: the
        largest of the six parameters.
    """
    crop = load.center_crop(*ERROR_CROP)
    exact = RenderMethod("exact", "torch", sh_degree=methods[0].sh_degree, dtype=torch.float64)
    exact_image, *exact_gradients = RenderTask(crop, exact).results()
    method_errors = {}
    for method in methods:
        image, *gradients = RenderTask(crop, method).results()
        difference = (image.double() - exact_image).abs()
        method_errors[method.name] = {
            "image_mean_error": difference.mean().item(),
            "image_max_error": difference.max().item(),
            "gradient_error": max(map(_relative_error, gradients, exact_gradients)),
        }
    return method_errors


def _relative_error(value: Tensor, exact: Tensor) -> float:
    norm = exact.norm()
    return ((value.double() - exact).norm() / norm).item() if norm > 0 else 0.0


def time_shortcuts(load: Load, backend: str, repeats: int) -> list[Row]:
    """Time rendering on one thread with each shortcut on and off, in turn.

    A shortcut skips work that does not change the result. The kinds of culling (`CullingOptions`)
    are shortcuts of the native backend. Both backends skip the bands of the spherical harmonics
    above the degree that training has reached.

    Returns:
        A row for each shortcut: `shortcut`, sizes, `times` (time off over time on), `same_bits`
        (whether image and gradients are equal on and off) and, with the prefixes `on_` and `off_`,
        times (ms), alpha evaluations and errors.
    """
    all_on = RenderMethod("on", backend)
    rows = []
    if backend == "native":
        one_off = [
            replace(
                all_on,
                name=option.name.replace("_", " "),
                culling=replace(CullingOptions(), **{option.name: False}),
            )
            for option in fields(CullingOptions)
        ]
        rows += _compare_shortcuts(load, all_on, one_off, repeats)
    # Early in training only band 0 is on. Without the shortcut, the other bands, all zeros, are
    # evaluated too.
    flat = load.gaussians._replace(shN=torch.zeros_like(load.gaussians.shN))
    one_off = [replace(all_on, name=INACTIVE_BANDS)]
    all_on = replace(all_on, sh_degree=0)
    return rows + _compare_shortcuts(replace(load, gaussians=flat), all_on, one_off, repeats)


def _compare_shortcuts(
    load: Load, all_on: RenderMethod, one_off: Sequence[RenderMethod], repeats: int
) -> list[Row]:
    methods = [all_on, *one_off]
    timed = {row["method"]: row for row in time_methods(load, methods, [1], repeats)}
    error = errors(load, methods)
    sides = {
        name: {key: row[key] for key in ("forward_ms", "backward_ms", "evaluations")} | error[name]
        for name, row in timed.items()
    }
    active = bases(all_on.sh_degree) - 1  # bases of shN whose gradients are compared
    *expected, expected_harmonics = RenderTask(load, all_on).results()
    rows = []
    for method in one_off:
        *gradients, harmonics = RenderTask(load, method).results()
        same = all(map(torch.equal, gradients, expected))
        same &= torch.equal(harmonics[:, :active], expected_harmonics[:, :active])
        on, off = sides[all_on.name], sides[method.name]
        rows.append(
            {
                "shortcut": method.name,
                **load.sizes,
                "backend": all_on.backend,
                "threads": 1,
                **{f"on_{key}": value for key, value in on.items()},
                **{f"off_{key}": value for key, value in off.items()},
                "times": total_ms(off) / total_ms(on),
                "same_bits": same,
            }
        )
    return rows


def fit_growth(rows: Sequence[Row]) -> list[Row]:
    """Fit power laws to the times of the first method on one thread.

    Returns:
        A row for each growing quantity (`grows`: "Gaussians" or "pixels") and each size of the
        other quantity (`at`), with `sizes` in ascending order, `ms` (forward plus backward), and
        the `exponent` of the power law: 1 if doubling the size doubles the time. The last two rows
        are for a fit to all loads. Quantities that do not vary have no rows.
    """
    frame = pd.DataFrame(rows)
    frame = frame[(frame["method"] == rows[0]["method"]) & (frame["threads"] == 1)]
    frame = pd.DataFrame(
        {
            "Gaussians": frame["gaussians"],
            "pixels": frame["width"] * frame["height"],
            "size": frame["width"].astype(str) + "x" + frame["height"].astype(str),
            "count": frame["gaussians"].map("{:,} Gaussians".format),
            "ms": frame["forward_ms"] + frame["backward_ms"],
        }
    )
    fits: list[Row] = []
    for grows, fixed, name in (("Gaussians", "pixels", "size"), ("pixels", "Gaussians", "count")):
        for _, group in frame.sort_values(grows).groupby(fixed):
            if len(group) > 1:
                fit = linregress(np.log(group[grows]), np.log(group["ms"]))
                row = {"grows": grows, "at": group[name].iloc[0], "sizes": group[grows].tolist()}
                fits.append(row | {"ms": group["ms"].tolist(), "exponent": float(fit.slope)})
    if len({row["grows"] for row in fits}) == 2:
        columns = [np.ones(len(frame)), np.log(frame["Gaussians"]), np.log(frame["pixels"])]
        _, *slopes = np.linalg.lstsq(np.stack(columns, axis=1), np.log(frame["ms"]), rcond=None)[0]
        for grows, slope in zip(("Gaussians", "pixels"), slopes, strict=True):
            fits.append({"grows": grows, "at": ALL_LOADS, "exponent": float(slope)})
    return fits
