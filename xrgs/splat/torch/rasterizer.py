"""The reference rasterizer: 3D Gaussian Splatting in plain torch, with gradients by autograd.

It composites as gsplat's CUDA kernels do. The native rasterizer is tested against it, so it runs in
any floating type.

A render finds the visible Gaussians, front to back; projects them; lists for every tile the
Gaussians that reach it; and composites the tiles in batches, each with lists padded to one length.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding, normalize, pad
from torch.utils.checkpoint import checkpoint

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.rendering import Render
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import sh_to_colors
from xrgs.splat.torch.elementwise import activated
from xrgs.splat.torch.projection import (
    ProjectedGaussians,
    conic_cholesky,
    depths,
    project,
    visible_by_depth,
)
from xrgs.splat.torch.tiles import TileBatch, TileGrid, build_tile_batches, intersect_tiles

TILE = 8
"""Side of a tile, px. The image does not depend on it; 8 is the fastest of 4, 8 and 16 in torch."""

BATCH_ELEMENTS = 1 << 18
"""Number of alpha values in a batch of tiles: 1 MB in float32, which fits in the cache."""

_LOG_OPACITY = 5
"""Column of the log opacity among the attributes of a Gaussian."""


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

    Shapes and types have been checked.
    """
    if raw:
        gaussians = activated(gaussians)
    means = gaussians.means
    if means2d_offset is None:
        means2d_offset = means.new_zeros((len(means), 2))
    _check_values(gaussians._asdict() | {"means2d_offset": means2d_offset})
    visible_ids, projected, attributes = _project_visible(
        gaussians, camera, settings, sh_degree, means2d_offset
    )
    grid = TileGrid(camera.width, camera.height, TILE)
    with torch.no_grad():
        pairs = intersect_tiles(projected, grid, settings)
        batches, lists = build_tile_batches(*pairs, grid, len(attributes), BATCH_ELEMENTS)
    canvas, canvas_bytes = _composite_batches(attributes, batches, lists, grid, settings)

    rgba = canvas.reshape(grid.rows, grid.columns, TILE, TILE, 4).transpose(1, 2)
    rgba = rgba.reshape(grid.rows * TILE, grid.columns * TILE, 4)
    rgba = rgba[: camera.height, : camera.width]  # [H, W, 4]
    alpha = rgba[..., 3]  # [H, W]
    background = means.new_tensor(settings.background)  # [3]
    evaluations = len(pairs[0]) * TILE**2
    return Render(
        image=rgba[..., :3] + (1 - alpha)[..., None] * background,
        alpha=alpha,
        visible=torch.zeros(len(means), dtype=torch.bool).index_fill(0, visible_ids, True),
        evaluations=evaluations,
        buffer_bytes=_bytes(*projected, attributes, *pairs, lists) + canvas_bytes,
        tile_evaluations=evaluations,
    )


def _check_values(values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"{name} has values that are not finite")
    if (values["scales"] < 0).any():
        raise ValueError("scales has values below 0")
    if ((values["opacities"] < 0) | (values["opacities"] > 1)).any():
        raise ValueError("opacities has values outside 0..1")


def _project_visible(
    gaussians: ActivatedGaussians,
    camera: Camera,
    settings: RasterSettings,
    sh_degree: int,
    means2d_offset: Tensor,
) -> tuple[Tensor, ProjectedGaussians, Tensor]:
    """Project the visible Gaussians, front to back.

    Returns:
        Their indices [M], the projected Gaussians, and the attributes for compositing: [M, 9] x, y,
        the Cholesky factor of the conic, log opacity, colour; with absgrad [M, 11], since an offset
        of value zero comes last.
    """
    means, quats, scales, opacities, sh0, shN = gaussians
    # With absgrad the means get the offset's value without its gradient: see `_PixelOffset`.
    mean_offset = means2d_offset.detach() if settings.absgrad else means2d_offset

    def project_some(ids: Tensor) -> ProjectedGaussians:
        shape = (means[ids], quats[ids], scales[ids], opacities[ids])
        projected = project(*shape, camera, settings)
        return projected._replace(means2d=projected.means2d + mean_offset[ids])

    with torch.no_grad():
        in_front = torch.nonzero(depths(means, camera) > settings.near)[:, 0]
        ids = in_front[visible_by_depth(project_some(in_front), camera, settings)]  # [M]
    # Projected again instead of masked, so that Gaussians behind the camera or with an overflow are
    # not in the graph, where their gradient would be 0 * inf.
    projected = project_some(ids)
    dirs = normalize(means[ids] - camera.position.to(means), dim=-1)  # [M, 3]
    colors = sh_to_colors(sh_degree, dirs, sh0[ids], shN[ids])  # [M, 3]
    log_opacities = torch.log(projected.opacities)[:, None]  # [M, 1]
    columns = [projected.means2d, conic_cholesky(projected), log_opacities, colors]
    if settings.absgrad:
        columns.append(means2d_offset[ids] - mean_offset[ids])
    return ids, projected, torch.cat(columns, dim=-1)


def _composite_batches(
    attributes: Tensor,
    batches: list[TileBatch],
    lists: Tensor,
    grid: TileGrid,
    settings: RasterSettings,
) -> tuple[Tensor, int]:
    """Composite every tile: [tiles, tile^2, 4], row by row, and the memory used, bytes."""
    padding = attributes.new_zeros((1, attributes.shape[1]))
    padding[:, _LOG_OPACITY] = float("-inf")
    listed = embedding(lists, torch.cat([attributes, padding]))  # [sum of B K, 9 or 11]
    by_batch = listed.split([len(batch.tiles) * batch.longest for batch in batches])
    outputs = []
    for batch, flat_entries in zip(batches, by_batch, strict=True):
        entries = flat_entries.reshape(len(batch.tiles), batch.longest, -1)  # [B, K, 9 or 11]
        # Recomputed in the backward pass: all alphas of a view would not fit in memory.
        rgba = checkpoint(
            composite,
            entries,
            grid.corners(batch.tiles).to(attributes),
            grid.tile,
            settings,
            use_reentrant=False,
            preserve_rng_state=False,
        )
        outputs.append(rgba)
    order = torch.argsort(torch.cat([batch.tiles for batch in batches]))
    canvas = torch.cat(outputs)[order]
    bytes_per_alpha = alpha_bytes(attributes.itemsize, absgrad=settings.absgrad)
    longest_batch = max(flat_entries.shape[0] for flat_entries in by_batch)
    peak = longest_batch * grid.tile**2 * bytes_per_alpha
    return canvas, _bytes(listed, canvas) + peak


def alpha_bytes(itemsize: int, *, absgrad: bool = False) -> int:
    """Return the bytes that `composite` saves for backward per pair of a pixel and a Gaussian."""
    # u, exponential, alpha, 1 - alpha, transmittance before and behind, weights, and two masks;
    # with absgrad also v and the two coordinates of the offset.
    return (10 if absgrad else 7) * itemsize + 2


class _PixelOffset(torch.autograd.Function):
    """Expand an offset [B, K, 2] to every pixel of a tile: x and y, [B, K, tile, tile] each.

    The backward pass sums the absolute values of the pixels' gradients: the homodirectional
    gradient of AbsGS [ye2024absgs], gsplat's `absgrad`.
    """

    @staticmethod
    def forward(_ctx: Any, offset: Tensor, tile: int) -> tuple[Tensor, Tensor]:
        x, y = offset[..., None, None].expand(-1, -1, -1, tile, tile).unbind(2)
        return x.clone(), y.clone()

    @staticmethod
    def backward(_ctx: Any, v_x: Tensor, v_y: Tensor) -> tuple[Tensor, None]:
        return torch.stack([v.abs().sum((-2, -1)) for v in (v_x, v_y)], dim=-1), None


def composite(entries: Tensor, corner: Tensor, tile: int, settings: RasterSettings) -> Tensor:
    """Composite tiles front to back (3D Gaussian Splatting, section 4, equation 3).

    `RasterSettings` tells what its limits of alpha and transmittance do.

    Args:
        entries: [B, K, 9] or [B, K, 11] attributes of `_project_visible` of each tile's Gaussians,
            front to back.
        corner: [B, 2] top left corner of each tile, px.
        tile: Side of a tile, px.
        settings: How Gaussians become pixels.

    Returns:
        [B, tile^2, 4] colour without background, and alpha.
    """
    x, y, c_xx, c_xy, c_yy, log_opacity = entries[..., :6, None].unbind(-2)  # [B, K, 1] each
    centre = torch.arange(tile, dtype=entries.dtype) + 0.5  # [tile]
    dx = corner[:, None, :1] + centre - x  # [B, K, tile]
    dy = corner[:, None, 1:] + centre - y
    u = (c_xx * dx)[:, :, None, :] + (c_xy * dy)[:, :, :, None]  # [B, K, tile, tile]
    v = (c_yy * dy)[:, :, :, None]  # [B, K, tile, 1]
    if settings.absgrad:
        offset_x, offset_y = _PixelOffset.apply(entries[..., 9:], tile)  # [B, K, tile, tile] each
        u = u - c_xx[..., None] * offset_x - c_xy[..., None] * offset_y
        v = v - c_yy[..., None] * offset_y
    row = log_opacity[..., None] - v.square()
    alpha = torch.exp(torch.addcmul(row, u, u, value=-1)).clamp_max(settings.alpha_max)
    alpha = alpha.flatten(2)  # [B, K, tile^2]
    alpha = torch.where(alpha < settings.alpha_min, 0.0, alpha)

    # Transmittance never rises, so the composited Gaussians are a prefix of the list.
    behind = torch.cumprod(1 - alpha, dim=1)  # [B, K, tile^2] transmittance behind each
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1)
    weights = torch.where(behind > settings.transmittance_min, alpha * before, 0.0)
    colors = pad(entries[..., 6:9], (0, 1), value=1.0)  # [B, K, 4]
    return weights.transpose(1, 2) @ colors


def _bytes(*tensors: Tensor) -> int:
    return sum(tensor.nbytes for tensor in tensors)
