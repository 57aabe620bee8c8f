"""Rendering of Gaussians into an image, on any backend."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from xrgs.splat.backend import DEVICES, implementation
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import C0, check_sh_degree
from xrgs.splat.torch_defaults import on_cpu_in_float32

#: Parameter -> shape for one Gaussian. The shape of shN depends on the number of bands.
_SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh0": (1, 3),
    "means2d_offset": (2,),
}

_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Render:
    """A rendered image, and the work and memory of rendering it."""

    image: Tensor
    """[H, W, 3], 0 and up: not clamped at 1."""
    alpha: Tensor
    """[H, W], 1 - transmittance."""
    visible: Tensor
    """[N] bool, whether each Gaussian reaches the image (`rasterize_parameters`)."""
    evaluations: int
    """Number of computed alphas: (pixel, Gaussian) pairs."""
    buffer_bytes: int
    """Peak memory of the renderer without parameters and their gradients, bytes."""
    tile_evaluations: int
    """What `evaluations` would be if every pixel evaluated every Gaussian of its tile's list."""


@on_cpu_in_float32
def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: RasterSettings | None = None,
    sh_degree: int | None = None,
    backend: str = "auto",
) -> Render:
    """Render Gaussians into one view.

    The render is differentiable in all six parameters of the Gaussians. The activation functions
    of scales and opacities are applied here.

    Args:
        gaussians: The N Gaussians, as raw parameters.
        camera: The pinhole camera of the view.
        settings: How Gaussians become pixels; None takes the defaults of `RasterSettings`.
        sh_degree: Highest evaluated band of the spherical harmonics, 0 to 3; None takes all stored
            bands, up to `settings.sh_degree`.
        backend: `native`, `torch`, `gsplat` (on a GPU), or `auto`: native for float32 if the
            extension was built, else torch.

    Returns:
        The render, with `image` [H, W, 3] (at least 0, not clamped at 1), `alpha` [H, W] in 0..1,
        and `visible` [N] bool.

    Raises:
        ValueError: A parameter has a wrong shape or type, or values that are not finite, or
            `sh_degree` is above the stored bands. The message names the parameter.
        XrgsError: The named backend can't be used on this machine (`resolve_backend`).

    Examples:
        >>> render = rasterize(gaussians, camera)
        >>> render.image.shape
        torch.Size([32, 48, 3])
        >>> render.image.mean().backward()
        >>> gaussians.means.grad.shape
        torch.Size([50, 3])
    """
    settings, backend = settings or RasterSettings(), backend_for(gaussians.means, backend)
    _check_harmonics(gaussians)
    if sh_degree is None:
        stored = math.isqrt(gaussians.shN.shape[1] + 1) - 1  # K = (degree + 1)^2
        sh_degree = min(settings.sh_degree, stored)
    return rasterize_parameters(
        *gaussians.raw()[:-1],
        gaussians.shN,  # `raw` returns shN detached
        camera,
        settings,
        sh_degree=sh_degree,
        raw=True,
        backend=backend,
    )


def rasterize_parameters(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    camera: Camera,
    settings: RasterSettings,
    *,
    sh_degree: int,
    means2d_offset: Tensor | None = None,
    raw: bool = False,
    backend: str = "torch",
) -> Render:
    """Render Gaussians into one view (3D Gaussian Splatting, with gsplat's constants).

    A Gaussian is visible if it is in front of `settings.near`, its opacity is at least
    `settings.alpha_min`, and the bounding box of the ellipse within which its alpha reaches
    `settings.alpha_min` overlaps the image.

    Args:
        means: [N, 3] world units.
        quats: [N, 4] wxyz, any length; zero is no rotation.
        scales: [N, 3] world units, at least 0; their natural logarithms with `raw`.
        opacities: [N] in 0..1; their logits with `raw`.
        sh0: [N, 1, 3] coefficients of band 0 of the spherical harmonics.
        shN: [N, K - 1, 3] coefficients of the higher bands.
        camera: The view.
        settings: How Gaussians become pixels.
        sh_degree: Highest band that is on, at most the highest band of shN.
        means2d_offset: [N, 2] px, added to the projected means. Its gradient is the image-plane
            gradient for densification (with `settings.absgrad`, the sum of absolute values).
        raw: Whether scales and opacities are raw parameters. The native backend activates them
            while reading, faster than `Gaussians.activated` and with the same bits.
        backend: `torch`, `native`, `gsplat` or `auto` (`resolve_backend`).

    Returns:
        The render, differentiable in every float tensor. On the native backend it is differentiable
        once, and its backward pass raises ValueError if a gradient is not finite
        (`native.rasterizer.render`).

    Raises:
        ValueError: A parameter has the wrong shape or type, or values that are not finite or out of
            range; `sh_degree` is not 0 to 3, or above the highest band of shN; or shN has more than
            15 coefficients. The message names the parameter.
        MemoryError: The tile lists of the view do not fit in memory.
    """
    gaussians = ActivatedGaussians(means, quats, scales, opacities, sh0, shN)
    named = gaussians._asdict()
    if means2d_offset is not None:
        named["means2d_offset"] = means2d_offset
    _check_shapes(named)
    check_sh_degree(sh_degree, shN)
    rasterizer = implementation("rasterizer", backend)
    render: Render = rasterizer.render(
        gaussians, camera, settings, sh_degree, means2d_offset, raw=raw
    )
    return render


def zero_means2d_offset(count: int, device: torch.device = _CPU) -> Tensor:
    """Return a zero `means2d_offset` [N, 2], whose `grad` becomes the image-plane gradient.

    All its elements share one number in memory, by which the native backend recognises the zeros
    and skips reading them.
    """
    return _zero(device).expand(count, 2).requires_grad_()


def is_zero_offset(offset: Tensor | None) -> bool:
    """Whether an offset was made by `zero_means2d_offset`."""
    return offset is not None and offset.data_ptr() == _zero(offset.device).data_ptr()


@cache
def _zero(device: torch.device) -> Tensor:
    """Return the zero that all offsets of `zero_means2d_offset` on a device share."""
    return torch.zeros((), dtype=torch.float32, device=device)


def backend_for(means: Tensor, backend: str) -> str:
    """Return `backend`, except for `auto` and means of a type other than float32: `torch`.

    Raises:
        ValueError: The tensor is on another device than the backend's.
    """
    where = DEVICES.get(backend, "cpu")
    if means.device.type != where:
        renderer = "xrgs renders on the CPU" if where == "cpu" else f"gsplat renders on {where}"
        raise ValueError(f"means is on {means.device}: {renderer}, use means.to({where!r})")
    return "torch" if backend == "auto" and means.dtype != torch.float32 else backend


def _check_harmonics(gaussians: Gaussians) -> None:
    """Check that all harmonics are finite; the kernels check only those of visible Gaussians."""
    for name in ("sh0", "shN"):
        value = getattr(gaussians, name).detach()
        if not value.sum().isfinite() and not torch.isfinite(value).all():
            raise ValueError(f"{name} has values that are not finite")


def _check_shapes(values: dict[str, Tensor]) -> None:
    means = values["means"]
    count = means.shape[0] if means.ndim else 0
    shapes = _SHAPES | {"shN": (*values["shN"].shape[1:2], 3)}
    for name, value in values.items():
        shape = (count, *shapes[name])
        if value.shape != shape:
            raise ValueError(f"{name} must be {list(shape)}, got {list(value.shape)}")
        if not value.is_floating_point() or value.dtype != means.dtype:
            raise ValueError(f"{name} must be of the floating type of means, got {value.dtype}")


@dataclass(frozen=True)
class Attribution:
    """The result of `attribute_pixels`."""

    sums: Tensor
    """[N] sums over the pixels, in the unit of the map times px; 0 for hidden Gaussians."""
    evaluations: int
    """Alpha evaluations of the forward pass (`Render.evaluations`)."""


@torch.enable_grad()
def attribute_pixels(
    pixels: Tensor,
    gaussians: ActivatedGaussians,
    camera: Camera,
    settings: RasterSettings,
    *,
    backend: str = "torch",
) -> Attribution:
    """Sum a map over a view's pixels for each Gaussian, by its blending weight in each pixel.

    The sum of Gaussian i is

        sum over p of e(p) w_i(p),   w_i(p) = alpha_i(p) T_i(p)

    where e is the map and w_i the weight with which the Gaussian's colour is blended into pixel p
    [kerbl2023, equation 3]. A render is linear in the colours, so the sum is the gradient of

        sum over p of e(p) image(p)

    with respect to the Gaussian's colour: one forward and one backward pass.

    Args:
        pixels: [H, W] the map e, of the Gaussians' dtype.
        gaussians: N Gaussians; their colours are not read.
        camera: The view.
        settings: How Gaussians become pixels.
        backend: `torch`, `native` or `auto` (`resolve_backend`).

    Returns:
        The sums, detached from autograd, and the number of alpha evaluations.

    Raises:
        ValueError: The map is not of the camera's size, or as for `rasterize_parameters`.
    """
    if pixels.shape != (camera.height, camera.width):
        raise ValueError(
            f"pixels must be {[camera.height, camera.width]} [H, W], got {list(pixels.shape)}"
        )
    constant = ActivatedGaussians(*(value.detach() for value in gaussians))
    # Colours of 0.5: the gradient of a colour that is clamped at 0 would be 0.
    constant = constant._replace(sh0=torch.zeros_like(constant.sh0).requires_grad_())
    render = rasterize_parameters(*constant, camera, settings, sh_degree=0, backend=backend)
    total = (pixels.detach() * render.image[..., 0]).sum()
    (gradient,) = torch.autograd.grad(total, constant.sh0)
    return Attribution(gradient[:, 0, 0] / C0, render.evaluations)
