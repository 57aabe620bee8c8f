"""Sums a map over a view's pixels for each Gaussian, by its blending weight in each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import C0


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
