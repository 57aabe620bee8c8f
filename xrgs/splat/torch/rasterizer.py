"""The readable renderer: 3D Gaussian Splatting in plain torch, gradients by autograd.

It is the oracle of every faster one, so it runs in any floating type. Compositing is that of
gsplat's CUDA kernels.

A render goes: which Gaussians are visible, front to back -> project them -> list, for every tile,
the Gaussians that reach it -> composite tiles in padded batches of similar list length.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding, normalize, pad
from torch.utils.checkpoint import checkpoint

from xrgs.splat.cameras import Camera
from xrgs.splat.rasterize import Render
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import sh_to_colors
from xrgs.splat.torch.projection import Projected, depths, project, visible_in_order, whitened
from xrgs.splat.torch.tiles import Batch, Grid, list_pairs, make_batches

TILE = 8
"""Side of a tile, px. Any gives the same image; 8 was the fastest of 4, 8 and 16 in torch."""

BATCH_ELEMENTS = 1 << 18
"""Alpha values of a batch of tiles: 1 MB in float32, so that a pass stays in the cache."""


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
    tile: int = TILE,
) -> Render:
    """`rasterize` with its arguments checked. Shapes, units and result as there.

    Raises:
        ValueError: sh_degree is not 0 to 3 or above the bands of shN.
        MemoryError: more (tile, Gaussian) pairs than fit in memory.
    """
    if means2d_offset is None:
        means2d_offset = means.new_zeros((len(means), 2))
    grid = Grid(camera.width, camera.height, tile)
    # With absgrad the means hold the offset's value, and pixels its gradient: see `_PixelOffset`.
    mean_offset = means2d_offset.detach() if settings.absgrad else means2d_offset

    def project_some(chosen: Tensor) -> Projected:
        shape = (means[chosen], quats[chosen], scales[chosen], opacities[chosen])
        flat = project(*shape, camera, settings)
        return flat._replace(means2d=flat.means2d + mean_offset[chosen])

    with torch.no_grad():
        in_front = torch.nonzero(depths(means, camera) > settings.near)[:, 0]
        chosen = in_front[visible_in_order(project_some(in_front), camera, settings)]  # [M]
    # Projected again rather than masked: what is behind the camera or overflows must stay out of
    # the graph, where its gradient would be 0 * inf.
    flat = project_some(chosen)
    dirs = normalize(means[chosen] - camera.position.to(means), dim=-1)
    colors = sh_to_colors(sh_degree, dirs, sh0[chosen], shN[chosen])
    columns = [whitened(flat), colors]
    if settings.absgrad:
        columns.append(means2d_offset[chosen] - mean_offset[chosen])
    records = torch.cat(columns, dim=-1)  # [M, 9], or [M, 11] with absgrad

    with torch.no_grad():
        pairs = list_pairs(flat, grid, settings)
        batches, index = make_batches(*pairs, grid, len(records), BATCH_ELEMENTS)
    canvas, canvas_bytes = _composite_batches(records, batches, index, grid, settings)

    rgba = canvas.reshape(grid.rows, grid.columns, tile, tile, 4).transpose(1, 2)
    rgba = rgba.reshape(grid.rows * tile, grid.columns * tile, 4)
    rgba = rgba[: camera.height, : camera.width]
    alpha = rgba[..., 3]
    background = means.new_tensor(settings.background)
    return Render(
        image=rgba[..., :3] + (1 - alpha)[..., None] * background,
        alpha=alpha,
        visible=torch.zeros(len(means), dtype=torch.bool).index_fill(0, chosen, True),
        evaluations=len(pairs[0]) * tile**2,
        buffer_bytes=_bytes(*flat, records, *pairs, index) + canvas_bytes,
    )


def _composite_batches(
    records: Tensor, batches: list[Batch], index: Tensor, grid: Grid, settings: RasterSettings
) -> tuple[Tensor, int]:
    """Composite every tile: [tiles, tile^2, 4] in row-major order, and the bytes that took."""
    null = records.new_zeros((1, records.shape[1]))
    null[:, 5] = float("-inf")  # the log of its opacity
    listed = embedding(index, torch.cat([records, null]))  # [sum of B K, 9 or 11]
    parts = listed.split([len(batch.tiles) * batch.longest for batch in batches])
    outputs = []
    for batch, part in zip(batches, parts, strict=True):
        entries = part.reshape(len(batch.tiles), batch.longest, -1)
        # Recomputed in the backward pass: a view's alphas at once would not fit in memory.
        rgba = checkpoint(
            composite,
            entries,
            grid.corners(batch.tiles).to(records),
            grid.tile,
            settings,
            use_reentrant=False,
            preserve_rng_state=False,
        )
        outputs.append(rgba)
    order = torch.argsort(torch.cat([batch.tiles for batch in batches]))
    canvas = torch.cat(outputs)[order]
    an_alpha = alpha_bytes(records.itemsize, absgrad=settings.absgrad)
    peak = max(part.shape[0] for part in parts) * grid.tile**2 * an_alpha
    return canvas, _bytes(listed, canvas) + peak


def alpha_bytes(itemsize: int, *, absgrad: bool = False) -> int:
    """What `composite` keeps for its backward pass, bytes an alpha value.

    u, the exponential, alpha, 1 - alpha, after, before and weights, and two masks; with absgrad v
    and the offset, too.
    """
    return (10 if absgrad else 7) * itemsize + 2


class _PixelOffset(torch.autograd.Function):
    """An offset [B, K, 2] handed to every pixel: x and y, [B, K, tile, tile] each.

    The offset's gradient is the sum of the absolute values of its pixels' gradients.
    """

    @staticmethod
    def forward(_ctx: Any, offset: Tensor, tile: int) -> tuple[Tensor, Tensor]:
        x, y = offset[..., None, None].expand(-1, -1, -1, tile, tile).unbind(2)
        return x.clone(), y.clone()

    @staticmethod
    def backward(_ctx: Any, v_x: Tensor, v_y: Tensor) -> tuple[Tensor, None]:
        return torch.stack([v.abs().sum((-2, -1)) for v in (v_x, v_y)], dim=-1), None


def composite(entries: Tensor, corner: Tensor, tile: int, settings: RasterSettings) -> Tensor:
    """Composite tiles front to back.

    A contribution below alpha_min is skipped, one above alpha_max is capped (no gradient), and a
    pixel ends before the Gaussian that would leave it transmittance_min or less.

    Args:
        entries: [B, K, 9] a tile's Gaussians: `whitened` and colour; with absgrad [B, K, 11], the
            offset, whose value is zero, behind them.
        corner: [B, 2] each tile's top left, px.
        tile: side of a tile, px.
        settings: the cut-offs.

    Returns:
        [B, tile^2, 4] colour without background, and alpha.
    """
    x, y, p, s, q, log_opacity = entries[..., :6, None].unbind(-2)  # [B, K, 1] each
    centre = torch.arange(tile, dtype=entries.dtype) + 0.5
    dx = corner[:, None, :1] + centre - x  # [B, K, tile]
    dy = corner[:, None, 1:] + centre - y
    u = (p * dx)[:, :, None, :] - (s * dy)[:, :, :, None]  # [B, K, tile, tile]
    v = (q * dy)[:, :, :, None]  # [B, K, tile, 1]
    if settings.absgrad:
        offset_x, offset_y = _PixelOffset.apply(entries[..., 9:], tile)
        u = u - p[..., None] * offset_x + s[..., None] * offset_y
        v = v - q[..., None] * offset_y
    row = log_opacity[..., None] - v.square()
    alpha = torch.exp(torch.addcmul(row, u, u, value=-1)).clamp_max(settings.alpha_max)
    alpha = alpha.flatten(2)  # [B, K, tile^2]
    alpha = torch.where(alpha < settings.alpha_min, 0.0, alpha)

    # Never frozen, the product falls on past the end: so what is kept is a prefix, exactly.
    after = torch.cumprod(1 - alpha, dim=1)  # [B, K, tile^2] transmittance behind each
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weights = torch.where(after > settings.transmittance_min, alpha * before, 0.0)
    colors = pad(entries[..., 6:9], (0, 1), value=1.0)  # [B, K, 4]
    return weights.transpose(1, 2) @ colors


def _bytes(*tensors: Tensor) -> int:
    return sum(tensor.nbytes for tensor in tensors)
