"""The face of rendering: one call, whichever backend does the work."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import torch
from torch import Tensor

from xrgs.splat.backend import resolve_backend
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Activated
from xrgs.splat.settings import RasterSettings

_MODULES = {"torch": "xrgs.splat.torch.rasterizer", "native": "xrgs.splat.native.rasterizer"}
#: Of one Gaussian; that of shN goes by its own bands.
_SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (),
    "sh0": (1, 3),
    "means2d_offset": (2,),
}


@dataclass(frozen=True)
class Render:
    """An image and what it took."""

    image: Tensor  # [H, W, 3], 0 and up: not clamped at 1
    alpha: Tensor  # [H, W], 1 - transmittance
    visible: Tensor  # [N] bool
    evaluations: int
    """Pixels that a Gaussian's alpha was computed at."""
    buffer_bytes: int
    """What the renderer allocates beside the parameters and their gradients, at its peak."""


def rasterize(
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

    A Gaussian is visible if it is in front of `settings.near`, its opacity reaches
    `settings.alpha_min` and the box around all it can colour overlaps the image.

    Args:
        means: [N, 3] world units.
        quats: [N, 4] wxyz, any length; zero is no rotation.
        scales: [N, 3] world units, at least 0.
        opacities: [N] in 0..1.
        sh0: [N, 1, 3]
        shN: [N, K - 1, 3]
        camera: the view.
        settings: how Gaussians become pixels.
        sh_degree: highest band that is on, at most the bands of shN.
        means2d_offset: [N, 2] px, added to the projected means: its gradient is the image-plane
            gradient that densification reads (with `settings.absgrad`, of absolute values).
        backend: `torch`, `native` or `auto` (`resolve_backend`).

    Returns:
        The render, differentiable in every float argument.

    Raises:
        ValueError: a parameter has the wrong shape or type, or values that are not finite or out
            of range; the message names it.
    """
    values = Activated(means, quats, scales, opacities, sh0, shN)
    named = values._asdict()
    if means2d_offset is not None:
        named["means2d_offset"] = means2d_offset
    _check_shapes(named)
    backend = resolve_backend(backend)
    if backend == "torch":  # the native one looks at values as it reads them
        _check_values(named)
    module = importlib.import_module(_MODULES[backend])
    render: Render = module.render(*values, camera, settings, sh_degree, means2d_offset)
    return render


def _check_shapes(values: dict[str, Tensor]) -> None:
    means = values["means"]
    count = means.shape[0] if means.ndim else 0
    shapes = _SHAPES | {"shN": (*values["shN"].shape[1:2], 3)}
    for name, value in values.items():
        _check(name, value, (count, *shapes[name]), means.dtype)


def _check(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
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
