"""Each kernel gives the same bits on any number of threads, and on all instruction sets that fuse.

Sizes are those that are cut into several tasks, with a remainder after whole vectors.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from tests.splat.scenes import make_camera, make_scene, noise, normal_parameters
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians, Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.native import elementwise
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.resample import resize
from xrgs.splat.settings import OptimizerSettings, RasterSettings

native = pytest.importorskip("xrgs._native")


def activate() -> list[Tensor]:
    # torch divides its own work among threads from 32,768 elements on.
    raw = normal_parameters(100_003, 0, size=10)
    leaves = [raw[name].requires_grad_() for name in ("scales", "opacities")]
    both = elementwise.exp(leaves[0]), elementwise.logistic(leaves[1])
    return [*both, *torch.autograd.grad(both, leaves, [value.cos() for value in both])]


def statistics() -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    gradient = 1e-4 * torch.randn(40_001, 2, generator=generator)
    visible = torch.rand(40_001, generator=generator) < 0.6
    sums = torch.zeros(40_001), torch.zeros(40_001)
    elementwise.accumulate_statistics(gradient, visible, (50.0, 37.5), *sums)
    return list(sums)


def moments() -> list[Tensor]:
    target = prepare_target(noise(75, 133).float(), backend="native")
    return [target.mean, target.variance]


def loss(height: int, width: int, *, weighted: bool) -> Callable[[], list[Tensor]]:
    def value_and_gradient() -> list[Tensor]:
        image = noise(height, width, 1).float().requires_grad_()
        target = prepare_target(noise(height, width, 2).float(), backend="native")
        weight = noise(height, width, 3)[..., 0].float() if weighted else None
        value = photometric_loss(
            image, target, l1=0.8, ssim=0.2, pixel_weight=weight, backend="native"
        )
        return [value.detach(), *torch.autograd.grad(value, image)]

    return value_and_gradient


def adam(*, of_a_view: bool) -> Callable[[], list[Tensor]]:
    def steps() -> list[Tensor]:
        leaves = {name: raw.requires_grad_() for name, raw in normal_parameters(2003, 0).items()}
        optimizer = SplatOptimizer(
            Gaussians(**leaves), OptimizerSettings(), scene_scale=2.0, steps=9, backend="native"
        )
        for step in range(3):
            for name, gradient in normal_parameters(2003, step).items():
                if name != "shN" or not of_a_view:
                    optimizer.gaussians[name].grad = gradient
            optimizer.step(make_camera() if of_a_view else None, sh_degree=3)
        found = [optimizer.gaussians[name].detach() for name in PARAMETERS]
        return found + [value for state in optimizer.adam.values() for value in state.values()]

    return steps


def resample(*, blur: bool) -> Callable[[], list[Tensor]]:
    def image_and_gradients() -> list[Tensor]:
        leaves = [noise(131, 203).float().requires_grad_()]
        if blur:
            leaves.append(torch.tensor([2.9, 1.7], dtype=torch.float64, requires_grad=True))
        resized = resize(
            leaves[0], 75, 300, variances=leaves[1] if blur else None, backend="native"
        )
        gradients = torch.autograd.grad(resized, leaves, noise(75, 300, 1).float() - 0.5)
        # In double, the order of a sum decides the last digits, which float32 does not hold.
        return [resized.detach(), *(gradient.float() for gradient in gradients)]

    return image_and_gradients


def render(count: int, raster: RasterSettings) -> Callable[[], list[Tensor]]:
    camera = make_camera(150, 110, focal=120.0, turned=True)
    scene = make_scene(count, camera, seed=12, size=2.0, dtype=torch.float32)

    def image_and_gradients() -> list[Tensor]:
        leaves = [scene[name].clone().requires_grad_() for name in PARAMETERS]
        leaves.append(torch.zeros(count, 2, requires_grad=True))
        made = rasterize_parameters(
            *ActivatedGaussians(*leaves[:-1]),
            camera,
            raster,
            sh_degree=3,
            means2d_offset=leaves[-1],
            backend="native",
        )
        slopes = noise(110, 150).float() - 0.5, noise(110, 150, 1)[..., 0].float()
        gradients = torch.autograd.grad((made.image, made.alpha), leaves, slopes)
        work = torch.tensor([made.evaluations, made.tile_evaluations])
        return [made.image.detach(), made.alpha.detach(), made.visible, work, *gradients]

    return image_and_gradients


OPERATIONS = {
    "activate": activate,
    "statistics": statistics,
    "moments": moments,
    "loss, small": loss(11, 40, weighted=False),
    "loss": loss(257, 33, weighted=False),
    "loss, weighted": loss(200, 300, weighted=True),
    "adam": adam(of_a_view=False),
    "adam of a view": adam(of_a_view=True),
    "resample": resample(blur=False),
    "blur": resample(blur=True),
    "render": render(20_003, RasterSettings()),
    "render, absgrad": render(3001, RasterSettings(antialiased=True, absgrad=True)),
}


@pytest.fixture
def restored() -> Iterator[None]:
    """Restores the instruction set and the number of threads."""
    isa, threads = native.isa(), torch.get_num_threads()
    yield
    native.set_isa(isa)
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.usefixtures("restored")
@pytest.mark.parametrize("name", OPERATIONS)
def test_threads_and_instruction_sets_change_no_bit(name: str) -> None:
    results: defaultdict[bool, list[list[Tensor]]] = defaultdict(list)
    for isa in native.available_isas():
        native.set_isa(isa)
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            results[native.fused_multiply_add()].append(OPERATIONS[name]())
    for first, *others in results.values():
        for other in others:
            assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))
