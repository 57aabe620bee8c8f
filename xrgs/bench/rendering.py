"""Times tasks in turn, and measures rendering: time, work, memory, error, the effect of culling."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from statistics import median
from typing import Any, TypeVar

import torch
from torch import Tensor

from xrgs.bench.loads import Load
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
Row = dict[str, Any]  # column -> value
_Key = TypeVar("_Key")


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
    """Renders one load with one method and number of threads, any number of times.

    Attributes:
        image: The last image, [H, W, 3], after a call of `backward`.
        work: Counts of the last render: `visible` Gaussians, alpha `evaluations`, and on the native
            backend (tile, Gaussian) `pairs`.
        buffer_bytes: Size of the buffers of the last render, bytes.
        stages: Stage -> its shortest time, ms; only on the native backend.
    """

    def __init__(self, load: Load, method: RenderMethod, count: int) -> None:
        self.camera, self.method, self.threads = load.camera, method, count
        leaves = (value.to(method.dtype).clone().requires_grad_() for value in load.parameters)
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
        with use_threads(self.threads):
            if self.method.culling is None:
                self.render = rasterize_parameters(
                    *self.leaves, *view, sh_degree=degree, backend=self.method.backend
                )
            else:
                from xrgs.splat.native import rasterizer as native

                culling = self.method.culling
                self.render = native.render_culled(self.leaves, *view, degree, None, culling)

    def backward(self) -> tuple[Tensor, ...]:
        """Return the gradients of the six parameters for the last render, and free the graph."""
        render, self.render = self.render, None
        assert render is not None, "forward() must be called first"  # noqa: S101
        graph: Any = render.image.grad_fn
        with use_threads(self.threads):
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
    """Time all methods on a load with each number of threads, and add the columns of `errors`.

    For large loads the torch backend is left out. For others it is timed at most twice, and its
    rows have `times_slower`, its time over that of the first native method.
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

    Rows have sizes, shortest and median times (ms), speed-up over the first number of threads,
    work, and memory (MiB).
    """
    tasks = {(m.name, count): RenderTask(load, m, count) for m in methods for count in counts}
    passes: dict[tuple[str, int, str], Callable[[], object]] = {}
    for key, task in tasks.items():
        passes[*key, "forward"] = task.forward
        passes[*key, "backward"] = task.backward
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
            "threads": task.threads,
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
    """Compare each method with the torch backend in float64 at gsplat's settings, by its name.

    Only the centre of the view (`ERROR_CROP`) is rendered. All methods must have the same
    `sh_degree`. `image_mean_error` and `image_max_error` are absolute errors of the image, and
    `gradient_error` is the norm of a gradient's error over the norm of the gradient: the largest of
    the six parameters.
    """
    crop, threads = load.center_crop(*ERROR_CROP), torch.get_num_threads()
    exact = RenderMethod("exact", "torch", sh_degree=methods[0].sh_degree, dtype=torch.float64)
    exact_image, *exact_gradients = RenderTask(crop, exact, threads).results()
    method_errors = {}
    for method in methods:
        image, *gradients = RenderTask(crop, method, threads).results()
        difference = (image.double() - exact_image).abs()
        method_errors[method.name] = {
            "image_mean_error": difference.mean().item(),
            "image_max_error": difference.max().item(),
            "gradient_error": max(
                ((value.double() - one).norm() / one.norm()).item() if one.any() else 0.0
                for value, one in zip(gradients, exact_gradients, strict=True)
            ),
        }
    return method_errors


def time_shortcuts(load: Load, backend: str, repeats: int) -> list[Row]:
    """Time rendering on one thread with each shortcut on and off, in turn.

    A shortcut skips work that does not change the result. The kinds of culling (`CullingOptions`)
    are shortcuts of the native backend. Both backends skip the bands of the spherical harmonics
    above the degree that training has reached. A row has the `shortcut`, sizes, `times` (time off
    over time on), `same_bits` (whether image and gradients are equal on and off) and, with the
    prefixes `on_` and `off_`, times (ms), alpha evaluations and errors.
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
    sh = torch.cat([load.sh[:, :1], torch.zeros_like(load.sh[:, 1:])], dim=1)
    one_off = [replace(all_on, name=INACTIVE_BANDS)]
    all_on = replace(all_on, sh_degree=0)
    return rows + _compare_shortcuts(replace(load, sh=sh), all_on, one_off, repeats)


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
    *expected, expected_harmonics = RenderTask(load, all_on, 1).results()
    rows = []
    for method in one_off:
        *gradients, harmonics = RenderTask(load, method, 1).results()
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


def time_interleaved(
    tasks: Mapping[_Key, Callable[[], object]], repeats: int
) -> dict[_Key, list[float]]:
    """Run each task once to warm up, then all tasks in turn (A B A B ...).

    In turn, so that other work on the machine slows down all tasks alike. Return the duration of
    each run, ms, by the task's key.
    """
    for task in tasks.values():
        task()
    durations: dict[_Key, list[float]] = {key: [] for key in tasks}
    # In turn, so that other work on the machine slows down all tasks alike.
    for _ in range(repeats):
        for key, task in tasks.items():
            start = time.perf_counter()
            task()
            durations[key].append(1e3 * (time.perf_counter() - start))
    return durations


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch and of the native kernels for a `with` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)  # the native kernels read torch's number
    try:
        yield
    finally:
        torch.set_num_threads(before)
