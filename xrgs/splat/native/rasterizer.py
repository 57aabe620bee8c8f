"""The compiled renderer (`xrgs/native`) as a torch operation.

The same image as `torch_rasterizer`, many times faster, in float32 on the CPU. What a forward pass
leaves for its backward pass lives in a `Frame`, whose memory is used again by the next render.
"""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from xrgs import _native
from xrgs.splat.cameras import Camera
from xrgs.splat.rasterize import Render
from xrgs.splat.settings import CullingOptions, RasterSettings
from xrgs.splat.sh import MAX_DEGREE, bases


def render(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    camera: Camera,
    settings: RasterSettings,
    sh_degree: int,
    means2d_offset: Tensor | None,
    skips: CullingOptions | None = None,
) -> Render:
    """`rasterize` on the compiled kernels. Shapes, units and result as there.

    With some `skips` off (None: all on) the image is the same and takes longer; without
    `out_of_view` or `sub_threshold` what these would drop counts as visible.

    Uses as many threads as torch (`torch.set_num_threads`); the result is bitwise the same for any
    number of them.

    Raises:
        ValueError: a parameter is not float32 or has values that are not finite (harmonics are
            read, and so checked, for visible Gaussians only), sh_degree is not 0 to 3, or shN has
            fewer bands than it asks for.
        MemoryError: the lists of the view do not fit in memory.
    """
    parameters = (means, quats, scales, opacities, sh0, shN)
    if means.dtype != torch.float32:
        raise ValueError(f"means must be float32 for the native backend, got {means.dtype}")
    if not 0 <= sh_degree <= MAX_DEGREE:
        raise ValueError(f"sh_degree must be 0 to {MAX_DEGREE}, got {sh_degree}")
    rest = bases(sh_degree) - 1
    if shN.shape[1] < rest:
        raise ValueError(f"sh_degree {sh_degree} needs shN of [N, {rest}, 3], got {[*shN.shape]}")
    frame = _native.Frame()
    view = _view(camera, settings, sh_degree, skips or CullingOptions())
    image, alpha = _Rasterize.apply(frame, view, *parameters, means2d_offset)
    return Render(
        image=image,
        alpha=alpha,
        visible=frame.visible(),
        evaluations=frame.evaluations,
        buffer_bytes=frame.bytes,
    )


def _view(
    camera: Camera, settings: RasterSettings, sh_degree: int, skips: CullingOptions
) -> _native.View:
    K = camera.K
    return _native.View.make(
        viewmat=camera.viewmat.flatten().tolist(),
        intrinsics=[K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()],
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
        skips=astuple(skips),
    )


def _plain(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.detach().contiguous()


class _Rasterize(torch.autograd.Function):
    """Image [H, W, 3] and alpha [H, W] of a frame, view, the six parameters and the offset."""

    @staticmethod
    def forward(
        ctx: Any, frame: _native.Frame, view: _native.View, *inputs: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        plain = [_plain(tensor) for tensor in inputs]
        ctx.frame = frame
        ctx.save_for_backward(*plain)
        image, alpha = frame.forward(view, *plain, torch.get_num_threads())
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alpha: Tensor) -> tuple[Tensor | None, ...]:
        threads = torch.get_num_threads()
        gradients = ctx.frame.backward(
            v_image.contiguous(),
            v_alpha.contiguous(),
            *ctx.saved_tensors,
            ctx.needs_input_grad[7],  # shN's, as large as all others three times over
            threads,
        )
        return (None, None, *gradients)
