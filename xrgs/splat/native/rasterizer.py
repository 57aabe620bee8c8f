"""The compiled rasterizer (`xrgs/csrc/raster`) as a torch operation.

It renders the same image as `xrgs.splat.torch.rasterizer`, many times faster, in float32 on the
CPU. A `Frame` holds the buffers of a forward pass that its backward pass needs; the next render
reuses their memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from xrgs import _native
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians
from xrgs.splat.native.arguments import handle, require_float32
from xrgs.splat.rendering import Render, is_zero_offset
from xrgs.splat.settings import CullingOptions, RasterSettings

_TILE = 16
"""Side of a tile, px: `kTileSize` of `xrgs/csrc/raster/types.h`."""
_CULLING = [field.name for field in fields(CullingOptions)]
"""Names of the culling options, in the order of `RenderConfig`'s argument."""
_ALL_CULLING = CullingOptions()
_FIRST_PARAMETER = 2
"""Index of the first parameter among the arguments of `_Rasterize.forward`."""
_SHN_INPUT = _FIRST_PARAMETER + PARAMETERS.index("shN")
"""Index of shN among the arguments of `_Rasterize.forward`."""


def render(
    gaussians: ActivatedGaussians,
    camera: Camera,
    settings: RasterSettings,
    sh_degree: int,
    means2d_offset: Tensor | None,
    *,
    raw: bool = False,
    culling: CullingOptions = _ALL_CULLING,
) -> Render:
    """Render Gaussians into one view as `xrgs.splat.rendering.rasterize_parameters` does.

    The number of threads is torch's (`torch.set_num_threads`). The result has the same bits for any
    number of threads. With `raw`, image and gradients have the bits of `exp`, `logistic` and then
    `render`, and one pass over memory is saved forward and one backward. With some kinds of
    `culling` off, to measure what they save, the image is the same; Gaussians that `out_of_view` or
    `sub_threshold` would have culled count as visible.

    The backward pass raises ValueError if a needed gradient is not finite. The message names the
    parameter, or the incoming gradient `v_image` or `v_alpha` if that one is not finite.

    Raises:
        ValueError: As for `rasterize_parameters`, or float32 cannot hold a number of the camera or
            the settings. Harmonics are only checked for visible Gaussians.
        MemoryError: The tile lists of the view do not fit in memory.
    """
    require_float32("means", gaussians.means)
    frame = _native.Frame()
    view = render_config(camera, settings, sh_degree, culling, raw=raw)
    image, alpha = _Rasterize.apply(frame, view, *gaussians, means2d_offset)
    return Render(
        image=image,
        alpha=alpha,
        visible=frame.visible(),
        evaluations=frame.evaluations,
        buffer_bytes=frame.bytes,
        tile_evaluations=frame.pair_count * _TILE**2,
    )


def render_config(
    camera: Camera,
    settings: RasterSettings,
    sh_degree: int,
    culling: CullingOptions,
    *,
    raw: bool = False,
) -> _native.RenderConfig:
    """Convert camera and settings to the config of `_native.Frame.forward`."""
    return _native.RenderConfig(
        viewmat=camera.numbers.viewmat,
        intrinsics=camera.numbers.intrinsics,
        width=camera.width,
        height=camera.height,
        near=settings.near,
        eps2d=settings.eps2d,
        alpha_min=settings.alpha_min,
        alpha_max=settings.alpha_max,
        transmittance_min=settings.transmittance_min,
        antialiased=settings.antialiased,
        absgrad=settings.absgrad,
        background=settings.background,
        sh_degree=sh_degree,
        culling=[getattr(culling, name) for name in _CULLING],
        raw=raw,
    )


def _handles(tensors: Sequence[Tensor | None]) -> list[Any]:
    return [None if tensor is None else handle(tensor) for tensor in tensors]


class _Rasterize(torch.autograd.Function):
    """Render image [H, W, 3] and alpha [H, W] from frame, view, six parameters and offset."""

    @staticmethod
    def forward(
        ctx: Any, frame: _native.Frame, view: _native.RenderConfig, *inputs: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        if is_zero_offset(inputs[-1]):  # its gradient needs no pass over zeros
            inputs = (*inputs[:-1], None)
        contiguous = [None if each is None else each.detach().contiguous() for each in inputs]
        ctx.frame = frame
        ctx.save_for_backward(*contiguous)
        image, alpha = frame.forward(view, *_handles(contiguous), torch.get_num_threads())
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alpha: Tensor) -> tuple[Tensor | None, ...]:
        *gradients, all_finite = ctx.frame.backward(
            *_handles((v_image.contiguous(), v_alpha.contiguous(), *ctx.saved_tensors)),
            ctx.needs_input_grad[_SHN_INPUT],  # three quarters of all gradients
            torch.get_num_threads(),
            ctx.needs_input_grad[-1],
        )
        if not all_finite:
            needed = ctx.needs_input_grad[_FIRST_PARAMETER:]
            _raise_if_not_finite(v_image, v_alpha, gradients, needed)
        return (None, None, *gradients)


def _raise_if_not_finite(
    v_image: Tensor, v_alpha: Tensor, gradients: Sequence[Tensor | None], needed: Sequence[bool]
) -> None:
    """Raise ValueError for the first needed gradient that is not finite, if there is one."""
    names = (*PARAMETERS, "means2d_offset")
    for name, gradient, is_needed in zip(names, gradients, needed, strict=True):
        if not is_needed or gradient is None or torch.isfinite(gradient).all():
            continue
        for incoming, source in (("v_image", v_image), ("v_alpha", v_alpha)):
            if not torch.isfinite(source).all():
                raise ValueError(
                    f"{incoming}, the gradient of the loss by the {incoming[2:]}, has values that"
                    " are not finite"
                )
        raise ValueError(
            f"the gradient of {name} is not finite: the parameters, the settings or the gradient"
            " of the image are too large or too small for float32"
        )
