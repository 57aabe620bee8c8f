"""Rendering of Gaussians into one view, on whichever backend is chosen."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.backend import implementation, resolve_backend
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.render_result import Render
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import check_sh_degree

__all__ = ["Render", "rasterize_parameters"]

#: Shape of one Gaussian's value; that of shN depends on how many bands it has.
_SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh0": (1, 3),
    "means2d_offset": (2,),
}


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
    backend: str = "torch",
) -> Render:
    """Render Gaussians into one view (3D Gaussian Splatting, with gsplat's constants).

    A Gaussian is visible if it is in front of `settings.near`, its opacity is at least
    `settings.alpha_min`, and the bounding box of the ellipse within which its alpha reaches
    `settings.alpha_min` overlaps the image.

    Args:
        means: [N, 3] world units.
        quats: [N, 4] wxyz, any length; zero is no rotation.
        scales: [N, 3] world units, at least 0.
        opacities: [N] in 0..1.
        sh0: [N, 1, 3] coefficients of band 0 of the spherical harmonics.
        shN: [N, K - 1, 3] coefficients of the higher bands.
        camera: The view.
        settings: How Gaussians become pixels.
        sh_degree: Highest band that is on, at most the bands of shN.
        means2d_offset: [N, 2] px, added to the projected means: its gradient is the image-plane
            gradient that densification reads (with `settings.absgrad`, of absolute values).
        backend: `torch`, `native` or `auto` (`resolve_backend`).

    Returns:
        The render, differentiable in every float argument; once only on the native backend, whose
        backward pass raises ValueError where a gradient is not finite (`native.rasterizer.render`).

    Raises:
        ValueError: A parameter has the wrong shape or type, or values that are not finite or out
            of range; or `sh_degree` is not 0 to 3 or above the bands of shN, of which there are at
            most 15. The message names the parameter.
        MemoryError: The tile lists of the view do not fit in memory.
    """
    gaussians = ActivatedGaussians(means, quats, scales, opacities, sh0, shN)
    named = gaussians._asdict()
    if means2d_offset is not None:
        named["means2d_offset"] = means2d_offset
    _check_shapes(named)
    check_sh_degree(sh_degree, shN)
    backend = resolve_backend(backend)
    if backend == "torch":  # the native backend checks values as it reads them
        _check_values(named)
    render: Render = implementation("rasterizer", backend).render(
        gaussians, camera, settings, sh_degree, means2d_offset
    )
    return render


def _check_shapes(values: dict[str, Tensor]) -> None:
    means = values["means"]
    count = means.shape[0] if means.ndim else 0
    shapes = _SHAPES | {"shN": (*values["shN"].shape[1:2], 3)}
    for name, value in values.items():
        _check_shape_and_type(name, value, (count, *shapes[name]), means.dtype)


def _check_shape_and_type(
    name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    if value.shape != shape:
        raise ValueError(f"{name} must be {list(shape)}, got {list(value.shape)}")
    if not value.is_floating_point() or value.dtype != dtype:
        raise ValueError(f"{name} must be of the floating type of means, got {value.dtype}")


def _check_values(values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"{name} has values that are not finite")
    if (values["scales"] < 0).any():
        raise ValueError("scales has values below 0")
    if ((values["opacities"] < 0) | (values["opacities"] > 1)).any():
        raise ValueError("opacities has values outside 0..1")
