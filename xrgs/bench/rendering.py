"""Rendering a load forward and back: its time by stage, its work and memory, and its error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from xrgs.bench.loads import Load
from xrgs.bench.timing import Times, alternate, threads
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rasterize import Render, rasterize
from xrgs.splat.settings import CullingOptions, RasterSettings

#: Size of the view in which a render is compared to one in double.
ERROR_CROP = (96, 72)
#: Loads that the torch backend renders in seconds, not minutes.
_TORCH_GAUSSIANS, _TORCH_PIXELS, _TORCH_REPEATS = 100_000, 504 * 378, 2


@dataclass(frozen=True)
class Way:
    """A backend, with settings that trade error for time."""

    name: str
    backend: str
    settings: RasterSettings = field(default_factory=RasterSettings)
    sh_degree: int = 3
    skips: CullingOptions | None = None
    """Of the native backend alone; None leaves out all that it can."""


def ways(backends: Sequence[str]) -> list[Way]:
    """Each backend as it is, and the fastest of them cutting off more than gsplat does."""
    first, usual = backends[0], RasterSettings()
    return [Way(name, name) for name in backends] + [
        Way(f"{first}, alpha cut 4/255", first, replace(usual, alpha_min=4 / 255)),
        Way(f"{first}, alpha cut 1/1020", first, replace(usual, alpha_min=1 / 1020)),
        Way(f"{first}, stop at 1e-2", first, replace(usual, transmittance_min=1e-2)),
    ]


class Rendering:
    """One load rendered one way by some threads, again and again."""

    def __init__(
        self, load: Load, way: Way, count: int, dtype: torch.dtype = torch.float32
    ) -> None:
        self.camera, self.way, self.threads = load.camera, way, count
        self.leaves = [p.to(dtype).clone().requires_grad_() for p in load.parameters]
        generator = torch.Generator().manual_seed(0)
        shape = (load.camera.height, load.camera.width, 3)
        self.slope = torch.randn(shape, generator=generator).to(dtype)  # of a loss, by the image
        self.render: Render | None = None
        self.image: Tensor | None = None
        self.work: dict[str, int] = {}
        self.stages: dict[str, float] = {}

    def forward(self) -> None:
        """Render, for one `backward`."""
        means, quats, scales, opacities, sh0, rest = self.leaves
        parameters = means, quats, scales, opacities, sh0, rest
        view, degree = (self.camera, self.way.settings), self.way.sh_degree
        with threads(self.threads):
            if self.way.skips is None:
                backend = self.way.backend
                self.render = rasterize(*parameters, *view, sh_degree=degree, backend=backend)
            else:
                from xrgs.splat.native import rasterizer as native

                gaussians = ActivatedGaussians(*parameters)
                self.render = native.render_culled(gaussians, *view, degree, None, self.way.skips)

    def backward(self) -> tuple[Tensor, ...]:
        """Gradients of the six parameters, of the last render, which is then let go."""
        render, self.render = self.render, None
        assert render is not None, "render first"  # noqa: S101 - a mistake of ours
        graph: Any = render.image.grad_fn
        with threads(self.threads):
            gradients = torch.autograd.grad(render.image, self.leaves, self.slope)
        self.image = render.image.detach()
        self.work = {
            "visible": int(render.visible.sum()),
            "evaluations": render.evaluations,
            "buffer_bytes": render.buffer_bytes,
        }
        if self.way.backend == "native":
            for stage, ms in graph.frame.timings.items():
                self.stages[stage] = min(ms, self.stages.get(stage, ms))
        return gradients


def time_load(load: Load, chosen: Sequence[Way], counts: Sequence[int], repeats: int) -> list[Any]:
    """A row for each way and number of threads, timed in turn.

    The torch backend is left out of loads too large for it. Else it takes its turns with the first
    of the others, fewer of them, and its rows say `times_slower` than that one it was.
    """
    fast = [way for way in chosen if way.backend != "torch"]
    rows = list(time_ways(load, fast, counts, repeats).values())
    if len(load) > _TORCH_GAUSSIANS or load.pixels > _TORCH_PIXELS:
        return rows
    slow = [way for way in chosen if way.backend == "torch"]
    timed = time_ways(load, [*fast[:1], *slow], counts, min(repeats, _TORCH_REPEATS))
    for way in slow:
        for count in counts:
            row = timed[way.name, count]
            if fast:
                row["times_slower"] = _whole(row) / _whole(timed[fast[0].name, count])
            rows.append(row)
    return rows


def _whole(row: dict[str, Any]) -> float:
    return float(row["forward_median_ms"] + row["backward_median_ms"])


def time_ways(
    load: Load, chosen: Sequence[Way], counts: Sequence[int], repeats: int
) -> dict[tuple[str, int], dict[str, Any]]:
    """A row for each way (by its name) and number of threads, all timed in turn."""
    renderings = {
        (way.name, count): Rendering(load, way, count) for way in chosen for count in counts
    }
    things: dict[str, Callable[[], object]] = {}
    for (name, count), rendering in renderings.items():
        things[f"{name} {count} forward"] = rendering.forward
        things[f"{name} {count} backward"] = rendering.backward
    times = alternate(things, repeats)
    return {
        (name, count): _row(
            load,
            rendering,
            times[f"{name} {count} forward"],
            times[f"{name} {count} backward"],
        )
        for (name, count), rendering in renderings.items()
    }


def _row(load: Load, rendering: Rendering, forward: Times, backward: Times) -> dict[str, Any]:
    work, stages = rendering.work, rendering.stages
    model = sum(leaf.nbytes for leaf in rendering.leaves)
    compositing = stages.get("composite", forward.least)
    return {
        "load": load.name,
        "way": rendering.way.name,
        "backend": rendering.way.backend,
        "threads": rendering.threads,
        "gaussians": len(load),
        "visible": work["visible"],
        "width": load.camera.width,
        "height": load.camera.height,
        "forward_ms": forward.least,
        "backward_ms": backward.least,
        "forward_median_ms": forward.median,
        "backward_median_ms": backward.median,
        "stages_ms": dict(stages),
        "evaluations": work["evaluations"],
        "evaluations_per_s": 1e3 * work["evaluations"] / compositing,
        "memory_bytes": 2 * model + work["buffer_bytes"],  # 2: parameters and gradients
    }


def errors(load: Load, chosen: Sequence[Way]) -> dict[str, dict[str, float]]:
    """How far each way, in float32, is from the torch backend at gsplat's settings in double.

    Over the middle of the view alone (`ERROR_CROP`), rendered as a view of its own: in double the
    whole of a large one would take minutes.

    Returns:
        For each way `image_mean` and `image_max`, absolute; `gradient`, the norm of the error
        over the norm of the gradient, of the worst of the six parameters.
    """
    crop = load.cropped(*ERROR_CROP)
    reference = Way("exact", "torch", sh_degree=chosen[0].sh_degree)
    exact = Rendering(crop, reference, torch.get_num_threads(), torch.float64)
    exact.forward()
    expected = exact.backward()
    found = {}
    for way in chosen:
        rendering = Rendering(crop, way, torch.get_num_threads())
        rendering.forward()
        gradients = rendering.backward()
        difference = (_image(rendering).double() - _image(exact)).abs()
        found[way.name] = {
            "image_mean": difference.mean().item(),
            "image_max": difference.max().item(),
            "gradient": max(map(_relative, gradients, expected)),
        }
    return found


def _image(rendering: Rendering) -> Tensor:
    assert rendering.image is not None, "render first"  # noqa: S101 - a mistake of ours
    return rendering.image


def _relative(value: Tensor, exact: Tensor) -> float:
    norm = exact.norm()
    return ((value.double() - exact).norm() / norm).item() if norm > 0 else 0.0


def time_views(load: Load, backend: str, counts: Sequence[int], repeats: int) -> list[Any]:
    """How time grows with views: one forward and backward pass of each, one after the other."""
    step = 0.02 * load.means[:, 2].median().item()  # world units, from one camera to the next
    renderings = []
    for number in range(max(counts)):
        viewmat = load.camera.viewmat.clone()
        viewmat[0, 3] += step * number
        view = load.seen_by(replace(load.camera, viewmat=viewmat))
        renderings.append(Rendering(view, Way(backend, backend), torch.get_num_threads()))

    def walk(count: int) -> None:
        for rendering in renderings[:count]:
            rendering.forward()
            rendering.backward()

    times = alternate({str(count): partial(walk, count) for count in counts}, repeats)
    return [{"views": count, "ms": times[str(count)].least} for count in counts]


def describe(way: Way) -> Mapping[str, Any]:
    """A way and all of its settings, for a program to read."""
    return {"name": way.name, "backend": way.backend, "settings": asdict(way.settings)}
