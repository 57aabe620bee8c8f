"""The compiled rasterizer compared with the torch one in float64, on the same float32 numbers.

A pixel where some alpha or transmittance is within 1e-4 of a threshold may fall on either side of
it: these pixels (the band) are found by moving the thresholds in the oracle. Outside it images must
agree to rounding, and gradients are compared with no weight on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import NamedTuple

import torch
from torch import Tensor

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians
from xrgs.splat.rendering import Render, rasterize_parameters
from xrgs.splat.settings import RasterSettings

Scene = Mapping[str, Tensor]
"""Activated parameters, and `means2d_offset` unless it is zero."""

BAND = 1e-4
FACTOR = 5.0
"""Gradients (their norms over all Gaussians) and images of hostile scenes (the pixel furthest off)
may err by this much more than torch's own float32."""
CANCELLED_FLOOR = {"scales": 1e-3, "quats": 1e-3}
"""Of a gradient's norm, where few pixels or Gaussians are left to cancel: first and second moments
are summed about the tile's centre, in float32, and what is asked for is about the mean. In 1,500
random scenes 1.2e-4 was needed for scales and 3e-5 for quaternions."""
CANCELLED_FLOOR_ELSE = 1e-4
"""Of all others: 2.4e-5 was needed, and below 1e-6 in 99 of 100 scenes."""
MOMENT_FLOOR = 64 * 2.0**-24
"""Or those of scales and quaternions, per relative change, by this share of that of the opacities:
where all pixels are next to the mean, they are what is left of second moments about the tile's
centre. Its border is 8 px away, and the square of that is rounded to float32."""


def run(
    scene: Scene,
    camera: Camera,
    raster: RasterSettings,
    backend: str,
    dtype: torch.dtype,
    v: tuple[Tensor, Tensor] | None = None,
    *,
    sh_degree: int = 3,
) -> tuple[Render, dict[str, Tensor]]:
    """The render, and with v the gradients of <image, v[0]> + <alpha, v[1]> by name."""
    values = {"means2d_offset": torch.zeros(len(scene["means"]), 2), **scene}
    leaves = {
        name: value.detach().to(dtype, copy=True).requires_grad_() for name, value in values.items()
    }
    render = rasterize_parameters(
        *ActivatedGaussians(*(leaves[name] for name in PARAMETERS)),
        camera,
        raster,
        sh_degree=sh_degree,
        means2d_offset=leaves["means2d_offset"],
        backend=backend,
    )
    if v is None:
        return render, {}
    v_image, v_alpha = (each.to(dtype) for each in v)
    value = (render.image * v_image).sum() + (render.alpha * v_alpha).sum()
    if value.requires_grad:
        torch.autograd.backward(value)
    return render, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def band_of(
    scene: Scene, camera: Camera, raster: RasterSettings, exact: Tensor, sh_degree: int
) -> Tensor:
    """Pixels [H, W] that a small move of a threshold changes."""
    band = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for factor in (1 - BAND, 1 + BAND):
        # Uncapped or not, an image hardly changes, but its gradient does.
        for name, change in (("alpha_min", 0), ("transmittance_min", 0), ("alpha_max", 1e-9)):
            moved = copy(raster)
            setattr(moved, name, getattr(raster, name) * factor)
            render, _ = run(scene, camera, moved, "torch", torch.float64, sh_degree=sh_degree)
            band |= (render.image - exact).abs().amax(-1) > change
    return band


class Expected(NamedTuple):
    """What the oracle has of a scene: shared by the instruction sets, whose tests come in turn."""

    exact: Render
    gradients: dict[str, Tensor]
    single_gradients: dict[str, Tensor]  # of torch's own float32
    band: Tensor  # [H, W]
    v: tuple[Tensor, Tensor]


_last: dict[tuple[object, ...], Expected] = {}


def expected_of(
    scene: Scene, camera: Camera, raster: RasterSettings, sh_degree: int, seed: int
) -> Expected:
    """Return what the oracle has; of the same arguments as in the last two calls, the same."""
    tensors = (*scene.values(), camera.viewmat, camera.K)
    key = (*scene, *(tensor.numpy().tobytes() for tensor in tensors), camera.width, camera.height)
    key = (*key, repr(raster), sh_degree, seed)
    if key not in _last:
        exact, _ = run(scene, camera, raster, "torch", torch.float64, sh_degree=sh_degree)
        band = band_of(scene, camera, raster, exact.image, sh_degree)
        generator = torch.Generator().manual_seed(seed)
        outside, size = (~band).float(), (camera.height, camera.width)
        v_image = torch.randn(*size, 3, generator=generator) * outside[..., None]
        v = v_image, torch.randn(*size, generator=generator) * outside
        (exact, gradients), (_, single_gradients) = (
            run(scene, camera, raster, "torch", dtype, v, sh_degree=sh_degree)
            for dtype in (torch.float64, torch.float32)
        )
        if len(_last) == 2:  # a test compares one scene with two settings at most
            del _last[next(iter(_last))]
        _last[key] = Expected(exact, gradients, single_gradients, band, v)
    return _last[key]


class Comparison(NamedTuple):
    """The compiled render with its gradients, the oracle's, and the pixels of the band."""

    ours: Render
    gradients: dict[str, Tensor]
    exact: Render
    band: Tensor  # [H, W]


def compare(
    scene: Scene,
    camera: Camera,
    raster: RasterSettings,
    *,
    sh_degree: int = 3,
    seed: int = 0,
    floor: float | None = None,
) -> Comparison:
    """Assert that image, alpha and gradients of a random loss are the oracle's but for rounding.

    `scene` and `camera` are in float32. `floor` is a share of each gradient's norm, in place of
    those where few pixels are left to cancel.
    """
    exact, expected_gradients, single_gradients, band, v = expected_of(
        scene, camera, raster, sh_degree, seed
    )
    ours, gradients = run(scene, camera, raster, "native", torch.float32, v, sh_degree=sh_degree)
    error = (ours.image.double() - exact.image).abs().detach()
    scale = max(1.0, float(exact.image.detach().max()))
    assert error.max() <= raster.alpha_min * scale + 1e-5  # one Gaussian more or less
    assert (error.amax(-1)[~band] <= 1e-5 * scale).all()
    assert ((ours.alpha.double() - exact.alpha).abs().detach()[~band] <= 1e-5).all()
    # Per relative change of a parameter, as dL/d(ln opacity), which all of the others come from.
    sizes = {"quats": scene["quats"].norm(dim=-1, keepdim=True), "scales": scene["scales"]}
    for name, expected in expected_gradients.items():
        got = gradients[name]
        assert torch.isfinite(got).all(), name
        assert (got[~ours.visible] == 0).all(), name
        share = floor or CANCELLED_FLOOR.get(name, CANCELLED_FLOOR_ELSE)
        allowed = FACTOR * (single_gradients[name] - expected).norm() + share * expected.norm()
        error = (got - expected).norm()
        if floor is None and name in sizes and error > allowed:
            opacity = (expected_gradients["opacities"] * scene["opacities"]).norm()
            assert ((got - expected) * sizes[name]).norm() <= MOMENT_FLOOR * opacity, name
        else:
            assert error <= allowed, name
    return Comparison(ours, gradients, exact, band)
