"""The simple way to render: Gaussians and a camera in, an image out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from xrgs.splat.backend import implementation
from xrgs.splat.rasterize import rasterize_parameters
from xrgs.splat.render_result import Render
from xrgs.splat.settings import RasterSettings

if TYPE_CHECKING:
    from torch import Tensor

    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: RasterSettings | None = None,
    sh_degree: int | None = None,
    backend: str = "auto",
) -> Render:
    """Render Gaussians into one view.

    The render is differentiable in all six parameters of the Gaussians. Scales and opacities are
    activated here: `Gaussians` holds natural logarithms of scales and logits of opacities.

    Args:
        gaussians: The N Gaussians, in raw parameters.
        camera: The pinhole camera of the view.
        settings: How Gaussians become pixels; None takes the defaults of `RasterSettings`.
        sh_degree: Highest band of the spherical harmonics that is evaluated, 0 to 3; None takes all
            bands that are stored, up to `settings.sh_degree`.
        backend: `native`, `torch`, or `auto`: native for float32 where the extension was built,
            else torch.

    Returns:
        The render: `image` [H, W, 3], which starts at 0 and is not clamped at 1, `alpha` [H, W] in
        0..1, and `visible` [N] bool.

    Raises:
        ValueError: A parameter has a wrong shape or type, or values that are not finite, or
            `sh_degree` is above the bands that are stored. The message names the parameter.
        XrgsError: The native backend is named and was not built.

    Example:
        >>> image = rasterize(load_ply("splats.ply"), camera).image  # doctest: +SKIP
    """
    settings = settings or RasterSettings()
    if sh_degree is None:
        stored = math.isqrt(gaussians.shN.shape[1] + 1) - 1  # K = (degree + 1)^2
        sh_degree = min(settings.sh_degree, stored)
    backend = backend_for(gaussians.means, backend)
    # Not `Gaussians.activated`, which cuts shN off from its gradient.
    activations = implementation("activations", backend)
    return rasterize_parameters(
        gaussians.means,
        gaussians.quats,
        activations.exp(gaussians.scales),
        activations.logistic(gaussians.opacities),
        gaussians.sh0,
        gaussians.shN,
        camera,
        settings,
        sh_degree=sh_degree,
        backend=backend,
    )


def backend_for(means: Tensor, backend: str) -> str:
    """Choose the backend that can render parameters of this floating type.

    Args:
        means: [N, 3] any parameter of the Gaussians.
        backend: `native`, `torch` or `auto`.

    Returns:
        `backend`; for `auto` and another type than float32, `torch`.

    Raises:
        ValueError: The tensor is not on the CPU.
    """
    if means.device.type != "cpu":
        raise ValueError(f"means is on {means.device}: xrgs renders on the CPU, use means.cpu()")
    return "torch" if backend == "auto" and means.dtype != torch.float32 else backend
