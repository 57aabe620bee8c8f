"""Measures rendering forward and backward: time by stage, work, memory and error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from xrgs.bench.loads import Load
from xrgs.bench.timing import Timings, time_interleaved, use_threads
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import Render, rasterize_parameters
from xrgs.splat.settings import CullingOptions, RasterSettings

#: Width and height, px, of the view in which a render is compared to one in float64.
ERROR_CROP = (96, 72)
#: Above these sizes the torch backend would take minutes, and isn't timed.
_TORCH_GAUSSIANS, _TORCH_PIXELS, _TORCH_REPEATS = 100_000, 504 * 378, 2
#: The name of the method whose results are the reference of all errors.
TORCH_FLOAT64 = "torch float64"


@dataclass(frozen=True)
class RenderMethod:
    """A backend with raster settings, which may trade error for time."""

    name: str
    backend: str
    settings: RasterSettings = field(default_factory=RasterSettings)
    sh_degree: int = 3
    culling: CullingOptions | None = None
    """The kinds of culling that the native backend uses; None means all of them."""
    dtype: torch.dtype = torch.float32


def default_methods(backends: Sequence[str]) -> list[RenderMethod]:
    """Return each backend at gsplat's settings, torch in float64, and the first with other cutoffs.

    Args:
        backends: Names of the backends, the fastest first.
    """
    first, usual = backends[0], RasterSettings()
    return [
        *(RenderMethod(name, name) for name in backends),
        RenderMethod(TORCH_FLOAT64, "torch", dtype=torch.float64),
        RenderMethod(f"{first}, alpha cut 4/255", first, replace(usual, alpha_min=4 / 255)),
        RenderMethod(f"{first}, alpha cut 1/1020", first, replace(usual, alpha_min=1 / 1020)),
        RenderMethod(f"{first}, stop at 1e-2", first, replace(usual, transmittance_min=1e-2)),
    ]


class RenderTask:
    """Renders one load with one method and number of threads, any number of times.

    Attributes:
        image: The last image, [H, W, 3], once `backward` was called.
        work: Visible Gaussians, alpha evaluations and bytes of buffers of the last render; with the
            native backend also the (tile, Gaussian) pairs.
        stages: The shortest time of each stage in ms, native backend only.
    """

    def __init__(self, load: Load, method: RenderMethod, count: int) -> None:
        self.camera, self.method, self.threads = load.camera, method, count
        self.leaves = [p.to(method.dtype).clone().requires_grad_() for p in load.parameters]
        generator = torch.Generator().manual_seed(0)
        shape = (load.camera.height, load.camera.width, 3)
        self.image_grad = torch.randn(shape, generator=generator).to(method.dtype)  # dL/d(image)
        self.render: Render | None = None
        self.image: Tensor | None = None
        self.work: dict[str, int] = {}
        self.stages: dict[str, float] = {}

    def forward(self) -> None:
        """Render the load and keep the graph for one call of `backward`."""
        means, quats, scales, opacities, sh0, rest = self.leaves
        parameters = means, quats, scales, opacities, sh0, rest
        view, degree = (self.camera, self.method.settings), self.method.sh_degree
        with use_threads(self.threads):
            if self.method.culling is None:
                backend = self.method.backend
                self.render = rasterize_parameters(
                    *parameters, *view, sh_degree=degree, backend=backend
                )
            else:
                from xrgs.splat.native import rasterizer as native

                gaussians = ActivatedGaussians(*parameters)
                culling = self.method.culling
                self.render = native.render_culled(gaussians, *view, degree, None, culling)

    def backward(self) -> tuple[Tensor, ...]:
        """Return the gradients of the six parameters for the last render, and free its graph."""
        render, self.render = self.render, None
        assert render is not None, "forward() must be called first"  # noqa: S101
        graph: Any = render.image.grad_fn
        with use_threads(self.threads):
            gradients = torch.autograd.grad(render.image, self.leaves, self.image_grad)
        self.image = render.image.detach()
        self.work = {
            "visible": int(render.visible.sum()),
            "evaluations": render.evaluations,
            "buffer_bytes": render.buffer_bytes,
        }
        if self.method.backend == "native":
            self.work["pairs"] = graph.frame.pair_count
            for stage, ms in graph.frame.timings.items():
                self.stages[stage] = min(ms, self.stages.get(stage, ms))
        return gradients


def time_load(
    load: Load, chosen: Sequence[RenderMethod], counts: Sequence[int], repeats: int
) -> list[Any]:
    """Time all methods on a load, in turn.

    The torch backend is left out if the load is too large for it. Otherwise it is timed in turn
    with the first native method, with fewer repeats, and its rows have `times_slower`: its time
    over that method's.

    Args:
        load: What is rendered.
        chosen: The methods.
        counts: Numbers of threads.
        repeats: Number of timed runs.

    Returns:
        A row for each method and number of threads, as `time_methods` gives it.
    """
    fast = [method for method in chosen if method.backend != "torch"]
    rows = list(time_methods(load, fast, counts, repeats).values())
    if len(load) > _TORCH_GAUSSIANS or load.pixels > _TORCH_PIXELS:
        return rows
    slow = [method for method in chosen if method.backend == "torch"]
    timed = time_methods(load, [*fast[:1], *slow], counts, min(repeats, _TORCH_REPEATS))
    for method in slow:
        for count in counts:
            row = timed[method.name, count]
            if fast:
                row["times_slower"] = _total_ms(row) / _total_ms(timed[fast[0].name, count])
            rows.append(row)
    return rows


def _total_ms(row: dict[str, Any]) -> float:
    return float(row["forward_median_ms"] + row["backward_median_ms"])


def time_methods(
    load: Load, chosen: Sequence[RenderMethod], counts: Sequence[int], repeats: int
) -> dict[tuple[str, int], dict[str, Any]]:
    """Time each method with each number of threads, all in turn.

    Args:
        load: What is rendered.
        chosen: The methods.
        counts: Numbers of threads.
        repeats: Number of timed runs.

    Returns:
        A row for each name of a method and number of threads: sizes, times in ms, work and memory.
    """
    renderings = {
        (method.name, count): RenderTask(load, method, count)
        for method in chosen
        for count in counts
    }
    tasks: dict[str, Callable[[], object]] = {}
    for (name, count), rendering in renderings.items():
        tasks[f"{name} {count} forward"] = rendering.forward
        tasks[f"{name} {count} backward"] = rendering.backward
    times = time_interleaved(tasks, repeats)
    return {
        (name, count): _row(
            load,
            rendering,
            times[f"{name} {count} forward"],
            times[f"{name} {count} backward"],
        )
        for (name, count), rendering in renderings.items()
    }


def _row(load: Load, rendering: RenderTask, forward: Timings, backward: Timings) -> dict[str, Any]:
    work, stages = rendering.work, rendering.stages
    model = sum(leaf.nbytes for leaf in rendering.leaves)
    compositing = stages.get("composite", forward.minimum)
    return {
        "load": load.name,
        "method": rendering.method.name,
        "backend": rendering.method.backend,
        "threads": rendering.threads,
        "gaussians": len(load),
        "visible": work["visible"],
        "width": load.camera.width,
        "height": load.camera.height,
        "forward_ms": forward.minimum,
        "backward_ms": backward.minimum,
        "forward_median_ms": forward.median,
        "backward_median_ms": backward.median,
        "stages_ms": dict(stages),
        "pairs": work.get("pairs"),
        "evaluations": work["evaluations"],
        "evaluations_per_s": 1e3 * work["evaluations"] / compositing,
        "memory_bytes": 2 * model + work["buffer_bytes"],  # 2: parameters and gradients
    }


def errors(load: Load, chosen: Sequence[RenderMethod]) -> dict[str, dict[str, float]]:
    """Compare each method to the torch backend at gsplat's settings in float64.

    Only the middle of the view (`ERROR_CROP`) is rendered, as a view of its own: a large view would
    take minutes in float64.

    Args:
        load: What is rendered.
        chosen: The methods.

    Returns:
        For each method's name, `image_mean` and `image_max`, the absolute error of the image, and
        `gradient`, the norm of the gradient's error over the gradient's norm, for the parameter
        of the six where it is largest.
    """
    crop = load.center_crop(*ERROR_CROP)
    reference = RenderMethod("exact", "torch", sh_degree=chosen[0].sh_degree, dtype=torch.float64)
    exact = RenderTask(crop, reference, torch.get_num_threads())
    exact.forward()
    expected = exact.backward()
    errors_by_name = {}
    for method in chosen:
        rendering = RenderTask(crop, method, torch.get_num_threads())
        rendering.forward()
        gradients = rendering.backward()
        difference = (_image(rendering).double() - _image(exact)).abs()
        errors_by_name[method.name] = {
            "image_mean": difference.mean().item(),
            "image_max": difference.max().item(),
            "gradient": max(map(_relative, gradients, expected)),
        }
    return errors_by_name


def _image(rendering: RenderTask) -> Tensor:
    assert rendering.image is not None, "backward() must be called first"  # noqa: S101
    return rendering.image


def _relative(value: Tensor, exact: Tensor) -> float:
    norm = exact.norm()
    return ((value.double() - exact).norm() / norm).item() if norm > 0 else 0.0


def time_views(load: Load, backend: str, counts: Sequence[int], repeats: int) -> list[Any]:
    """Time the forward and backward passes of several views, one after the other.

    Args:
        load: The Gaussians and the first view; the others are beside it.
        backend: "native" or "torch".
        counts: Numbers of views.
        repeats: Number of timed runs.

    Returns:
        A row for each number of views: `views` and `ms`.
    """
    baseline = 0.02 * load.means[:, 2].median().item()  # between cameras, world units
    renderings = []
    for number in range(max(counts)):
        viewmat = load.camera.viewmat.clone()
        viewmat[0, 3] += baseline * number
        view = load.with_camera(replace(load.camera, viewmat=viewmat))
        renderings.append(RenderTask(view, RenderMethod(backend, backend), torch.get_num_threads()))

    def render_views(count: int) -> None:
        for rendering in renderings[:count]:
            rendering.forward()
            rendering.backward()

    times = time_interleaved(
        {str(count): partial(render_views, count) for count in counts}, repeats
    )
    return [{"views": count, "ms": times[str(count)].minimum} for count in counts]


def describe(method: RenderMethod) -> Mapping[str, Any]:
    """Return a method with all of its settings as JSON values.

    Args:
        method: What is described.
    """
    dtype = str(method.dtype).removeprefix("torch.")
    settings = asdict(method.settings)
    return {"name": method.name, "backend": method.backend, "dtype": dtype, "settings": settings}
