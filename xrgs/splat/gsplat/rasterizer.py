"""Rendering by `gsplat.rasterization` [ye2025], for gsplat 1.5.3 and 1.6.

Importing this module loads gsplat's CUDA kernels. The first time on a machine, gsplat compiles
them, which takes minutes.
"""

from __future__ import annotations

import subprocess
import weakref
from typing import Any

import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.backend import DEVICES, check_raster
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import Render, is_zero_offset
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import bases
from xrgs.splat.torch.elementwise import activated


def _load() -> Any:
    """Return gsplat with its kernels.

    Raises:
        XrgsError: There is no GPU or no kernels; the message says what is missing.
    """
    if DEVICES["gsplat"] == "cuda" and not torch.cuda.is_available():
        built = f"CUDA {torch.version.cuda}" if torch.version.cuda else "the CPU only"
        raise XrgsError(
            f"splat.backend=gsplat: torch {torch.__version__}, built for {built}, sees no CUDA GPU;"
            " does nvidia-smi list one? It needs torch for its CUDA (pytorch.org)"
        )
    failure: Exception = ImportError("not compiled, and gsplat finds no CUDA compiler")
    try:
        import gsplat
        from gsplat.cuda import _backend

        kernels = _backend._C
    except (ImportError, OSError, RuntimeError, subprocess.SubprocessError) as error:
        kernels, failure = None, error
    if kernels is None:
        reason = str(failure).strip().partition("\n")[0]
        raise XrgsError(
            f"splat.backend=gsplat: gsplat's kernels can't be loaded ({reason}); to compile them"
            " takes nvcc of torch's CUDA, on the PATH or below CUDA_HOME, a C++ compiler and ninja"
        ) from failure
    # TF32 would cut the factors in the loss's convolutions to 10 bits.
    torch.backends.cudnn.allow_tf32 = False
    return gsplat


_gsplat = _load()


def render(
    gaussians: ActivatedGaussians,
    camera: Camera,
    settings: RasterSettings,
    sh_degree: int,
    means2d_offset: Tensor | None,
    *,
    raw: bool = False,
) -> Render:
    """Render Gaussians into one view as `xrgs.splat.rendering.rasterize_parameters` does.

    Values may be infinite or NaN. A Gaussian is `visible` if its radii in px, rounded up, reach the
    image. `evaluations` counts all pixels of a tile, also saturated ones. `buffer_bytes` is 0: on a
    GPU, `TrainingMemory` counts all that torch allocates, gsplat's buffers included.

    Raises:
        ValueError: The offset is not made by `zero_means2d_offset`: gsplat can't add an offset.
        XrgsError: A setting differs from the constants of gsplat's kernels.
    """
    check_raster("gsplat", settings)
    if means2d_offset is not None and len(means2d_offset) and not is_zero_offset(means2d_offset):
        raise ValueError("means2d_offset must be of zero_means2d_offset: gsplat adds no offset")
    if raw:
        gaussians = activated(gaussians)
    means, quats, scales, opacities, sh0, shN = gaussians
    if means2d_offset is not None:
        means = _with_gradient_of(means2d_offset, means, settings.absgrad)
    image, alpha, meta = _gsplat.rasterization(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=torch.cat([sh0, shN[:, : bases(sh_degree) - 1]], dim=1),
        viewmats=camera.viewmat.to(means)[None],
        Ks=camera.K.to(means)[None],
        width=camera.width,
        height=camera.height,
        near_plane=settings.near,
        eps2d=settings.eps2d,
        sh_degree=sh_degree,
        packed=False,
        backgrounds=means.new_tensor([settings.background]),
        absgrad=settings.absgrad,
        rasterize_mode="antialiased" if settings.antialiased else "classic",
    )
    if means2d_offset is not None:
        meta["means2d"].retain_grad()
        means2d_offset.gsplat_means2d = meta["means2d"]  # type: ignore[attr-defined]
    evaluations = len(meta["flatten_ids"]) * meta["tile_size"] ** 2
    return Render(
        image=image[0],
        alpha=alpha[0, ..., 0],
        visible=(meta["radii"][0] > 0).all(dim=-1),
        evaluations=evaluations,
        buffer_bytes=0,
        tile_evaluations=evaluations,
    )


def _with_gradient_of(means2d_offset: Tensor, means: Tensor, absgrad: bool) -> Tensor:
    """Return the means with a hook that copies the gradient of gsplat's `means2d` to the offset.

    The hook runs after gsplat's backward pass, when the gradient of `means2d` is complete.
    `means2d` holds the graph, so a hook that holds `means2d` would never be freed: the offset holds
    `means2d`, and the hook has a weak reference to the offset.
    """
    means, offset_of = means.view_as(means), weakref.ref(means2d_offset)

    def give(_: Tensor) -> None:
        if (offset := offset_of()) is not None:
            means2d = offset.gsplat_means2d  # type: ignore[attr-defined]  # [1, N, 2]
            offset.grad = (means2d.absgrad if absgrad else means2d.grad)[0]

    means.register_hook(give)
    return means
