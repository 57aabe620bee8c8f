"""Small random scenes, cameras, images and strategies for the tests of the model."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians, Gaussians
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import Render, rasterize_parameters
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings
from xrgs.splat.strategy.base import Groups
from xrgs.splat.strategy.default import DefaultStrategy

Scene = dict[str, Tensor]
"""Activated parameters by name."""
SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh0": (1, 3),
    "shN": (15, 3),
}
"""Of each parameter of one Gaussian, with all bands."""


def normal_parameters(
    count: int, seed: int, *, size: float = 1.0, dtype: torch.dtype = torch.float32
) -> Scene:
    """Raw parameters, or gradients of them, of a normal distribution."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: size * torch.randn(count, *shape, generator=generator, dtype=dtype)
        for name, shape in SHAPES.items()
    }


def make_camera(
    width: int = 20, height: int = 14, *, focal: float = 18.0, turned: bool = False
) -> Camera:
    """At the origin, or turned and moved; the principal point is off the centre."""
    K = torch.tensor(
        [[focal, 0, 0.45 * width], [0, 1.1 * focal, 0.6 * height], [0, 0, 1]],
        dtype=torch.float64,
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    if turned:
        generator = torch.Generator().manual_seed(5)
        q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        viewmat[:3, :3] = q * torch.linalg.det(q)
        viewmat[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    return Camera(viewmat, K, width, height)


def make_scene(
    count: int,
    camera: Camera,
    *,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
    size: float = 2.0,
) -> Scene:
    """Activated parameters of Gaussians some `size` px large, in and around the image."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    z = 2 + 3 * uniform(count)
    pixel = (uniform(count, 2) * 1.3 - 0.15) * torch.tensor([camera.width, camera.height])
    K = camera.K.double()
    x = (pixel[:, 0] - K[0, 2]) / K[0, 0] * z
    y = (pixel[:, 1] - K[1, 2]) / K[1, 1] * z
    rotation, shift = camera.viewmat[:3, :3].double(), camera.viewmat[:3, 3].double()
    scene = {
        "means": (torch.stack([x, y, z], dim=-1) - shift) @ rotation,
        "quats": normal(count, 4),
        "scales": torch.exp(0.5 * normal(count, 3)) * size * z[:, None] / K[0, 0],
        "opacities": 0.05 + 0.9 * uniform(count),
        "sh0": normal(count, 1, 3),
        "shN": 0.3 * normal(count, 15, 3),
    }
    return {name: value.to(dtype) for name, value in scene.items()}


def single_pixel(count: int, *, opacity: float, dtype: torch.dtype = torch.float32) -> Scene:
    """Wide Gaussians behind one another on the optical axis, the first nearest."""
    means = torch.zeros(count, 3, dtype=dtype)
    means[:, 2] = 1 + torch.arange(count, dtype=dtype)
    return {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).repeat(count, 1),
        "scales": torch.full((count, 3), 0.1, dtype=dtype),
        "opacities": torch.full((count,), opacity, dtype=dtype),
        "sh0": torch.ones(count, 1, 3, dtype=dtype),
        "shN": torch.zeros(count, 0, 3, dtype=dtype),
    }


def draw(
    scene: Scene,
    camera: Camera,
    raster: RasterSettings | None = None,
    *,
    sh_degree: int = 3,
    **options: Any,
) -> Render:
    """Render a scene, by default with all bands and settings of gsplat."""
    gaussians = ActivatedGaussians(*(scene[name] for name in PARAMETERS))
    settings = raster or RasterSettings()
    return rasterize_parameters(*gaussians, camera, settings, sh_degree=sh_degree, **options)


def with_gradients(scene: Scene) -> Scene:
    """A copy of a scene in leaves that gradients accumulate on."""
    return {name: value.clone().requires_grad_() for name, value in scene.items()}


def gradients_of(leaves: Scene) -> Scene:
    """The gradients of leaves, each of which must have one."""
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    assert gradients.keys() == leaves.keys()
    return gradients


def make_optimizer(
    values: Scene,
    settings: OptimizerSettings | None = None,
    *,
    scene_scale: float = 1.0,
    steps: int = 1,
    backend: str = "torch",
) -> SplatOptimizer:
    """An optimizer of Gaussians with these raw parameters, by default with rates that stay."""
    leaves = {name: values[name].clone().requires_grad_() for name in PARAMETERS}
    return SplatOptimizer(
        Gaussians(**leaves),
        settings or OptimizerSettings(means_final=1.0),
        scene_scale=scene_scale,
        steps=steps,
        backend=backend,
    )


def take_step(
    optimizer: SplatOptimizer, gradients: Scene, camera: Camera | None = None, sh_degree: int = 0
) -> None:
    """A step by gradients of some parameters."""
    optimizer.zero_grad()
    for name, gradient in gradients.items():
        optimizer.gaussians[name].grad = gradient.clone()
    optimizer.step(camera, sh_degree=sh_degree)


def make_strategy(
    values: Scene,
    settings: DensifySettings | None = None,
    *,
    scene_scale: float = 1.0,
    seed: int = 0,
    groups: Groups | None = None,
    backend: str = "torch",
    view_pixels: int = 0,
) -> DefaultStrategy:
    """A strategy of Gaussians with these raw parameters, whose optimizer took no step."""
    return DefaultStrategy(
        make_optimizer(values, scene_scale=scene_scale, backend=backend),
        settings or DensifySettings(),
        scene_scale=scene_scale,
        generator=torch.Generator().manual_seed(seed),
        groups=groups,
        view_pixels=view_pixels,
    )


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    """A float64 image [H, W, 3] in 0..1."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(height, width, 3, generator=generator, dtype=torch.float64)


def similar_pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Two images of the same waves, each with noise of its own: their SSIM is about 0.5."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = 0.5 + 0.3 * torch.sin(x / 5.0 + y / 3.0)[..., None].expand(-1, -1, 3).double()
    first, second = (noise(height, width, seed) - 0.5 for seed in (0, 1))
    return waves + 0.2 * first, waves + 0.2 * second
