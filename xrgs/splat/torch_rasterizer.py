"""The readable renderer: 3D Gaussian Splatting in plain torch, gradients by autograd.

It is the oracle of every faster one, so it runs in any floating type. Projection as gsplat 1.5's
`_torch_impl.py`, compositing as its CUDA kernels; the one difference is that the quadratic form is
evaluated in whitened coordinates, which have no cancellation (RASTERIZER.md, numerical cases).

A render goes: which Gaussians are visible -> project them -> sort by depth -> list, for every
tile, the Gaussians that reach it -> composite tiles in padded batches of similar list length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding, normalize, pad
from torch.utils.checkpoint import checkpoint

from xrgs.splat.cameras import Camera
from xrgs.splat.rasterize import Render
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import sh_to_colors

TILE = 8
"""Side of a tile, px. Any gives the same image; 8 was the fastest of 4, 8, 16 here."""

BATCH_ELEMENTS = 1 << 18
"""Alpha values of a batch of tiles: 1 MB in float32, so that a pass stays in the cache."""

MAX_PAIRS = 1 << 27
"""(tile, Gaussian) pairs that fit in memory: some 80 bytes each, so 10 GB."""

CLAMP_MARGIN = 0.3
"""Share of the half field of view that the Jacobian may look beyond the image (gsplat's 1.3)."""

RADIUS_MARGIN = 0.01
"""Added to the squared radius in sigmas when listing, so that rounding never drops a pixel."""


class Projected(NamedTuple):
    """Gaussians in the image plane."""

    means2d: Tensor  # [M, 2] px
    cov: Tensor  # [M, 3] xx, xy, yy of the dilated covariance, px^2
    det: Tensor  # [M] of that covariance
    opacities: Tensor  # [M], compensated if antialiased
    depths: Tensor  # [M] world units


@dataclass(frozen=True)
class Batch:
    """Tiles composited together, every list padded to the longest."""

    tiles: Tensor  # [B]
    longest: int  # K


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
) -> Render:
    """`rasterize` with its arguments checked. Shapes, units and result as there.

    Raises:
        ValueError: sh_degree is not 0 to 3 or above the bands of shN.
        MemoryError: more (tile, Gaussian) pairs than fit in memory.
    """
    if means2d_offset is None:
        means2d_offset = means.new_zeros((len(means), 2))

    def project_some(chosen: Tensor) -> Projected:
        shape = (means[chosen], quats[chosen], scales[chosen], opacities[chosen])
        flat = project(*shape, camera, settings)
        return flat._replace(means2d=flat.means2d + means2d_offset[chosen])

    # Choosing first keeps what is behind the camera or overflows out of the graph altogether:
    # masked afterwards, its gradient would be 0 * inf.
    with torch.no_grad():
        chosen = torch.nonzero(depths(means, camera) > settings.near)[:, 0]
        flat = project_some(chosen)
        seen = reaches_image(flat, camera.width, camera.height, settings)
        order = torch.argsort(flat.depths[seen], stable=True)  # ties: the lower index first
        chosen = chosen[seen][order]  # [M]
    flat = project_some(chosen)
    dirs = normalize(means[chosen] - camera.position.to(means), dim=-1)
    colors = sh_to_colors(sh_degree, dirs, sh0[chosen], shN[chosen])

    records = torch.cat([whitened(flat), colors], dim=-1)  # [M, 9]
    with torch.no_grad():
        tile, gaussian = list_pairs(flat, camera.width, camera.height, settings)
        columns, rows = _tile_counts(camera.width, camera.height)
        batches, index = make_batches(tile, gaussian, columns * rows, len(records))
    canvas, batch_bytes = _composite_batches(records, batches, index, columns, settings)

    rgba = canvas.reshape(rows, columns, TILE, TILE, 4).transpose(1, 2)
    rgba = rgba.reshape(rows * TILE, columns * TILE, 4)[: camera.height, : camera.width]
    alpha = rgba[..., 3]
    background = means.new_tensor(settings.background)
    visible = torch.zeros(len(means), dtype=torch.bool)
    visible[chosen] = True
    return Render(
        image=rgba[..., :3] + (1 - alpha)[..., None] * background,
        alpha=alpha,
        visible=visible,
        evaluations=len(gaussian) * TILE * TILE,
        buffer_bytes=_bytes(*flat, records, tile, gaussian, index, canvas) + batch_bytes,
    )


def depths(means: Tensor, camera: Camera) -> Tensor:
    """Distance of means [N, 3] along the camera's axis: [N], world units."""
    forward = camera.viewmat[2].to(means)
    return means @ forward[:3] + forward[3]


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    settings: RasterSettings,
) -> Projected:
    """Project Gaussians in front of the camera: EWA, the covariance through the local Jacobian.

    Args:
        means: [M, 3], all in front of the near plane.
        quats: [M, 4]
        scales: [M, 3]
        opacities: [M]
        camera: the view.
        settings: `eps2d` and `antialiased` are read.
    """
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)  # [M] each
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    # Far outside the image the affine approximation blows up: hold its point at the border.
    slope_x = _clamp_slope(x / z, cx / fx, (camera.width - cx) / fx)
    slope_y = _clamp_slope(y / z, cy / fy, (camera.height - cy) / fy)
    axes = viewmat[:3, :3] @ (rotations(quats) * scales[:, None, :])  # [M, 3, 3] camera axes
    m1 = (fx / z)[:, None] * (axes[:, 0] - slope_x[:, None] * axes[:, 2])  # [M, 3]
    m2 = (fy / z)[:, None] * (axes[:, 1] - slope_y[:, None] * axes[:, 2])

    # det([m1; m2] [m1; m2]^T + eps I), expanded so that nothing cancels: ac - b^2 does in float32.
    eps = settings.eps2d
    xx, xy, yy = (m1 * m1).sum(-1), (m1 * m2).sum(-1), (m2 * m2).sum(-1)
    area = torch.linalg.vector_norm(torch.linalg.cross(m1, m2), dim=-1)  # sqrt(det), undilated
    det = area * area + eps * (xx + yy) + eps * eps
    if settings.antialiased:
        opacities = opacities * area / det.sqrt()
    cov = torch.stack([xx + eps, xy, yy + eps], dim=-1)
    return Projected(means2d, cov, det, opacities, z)


def _clamp_slope(slope: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Hold x/z within the image, whose borders are at -before and after, and a margin."""
    margin = CLAMP_MARGIN * 0.5 * (before + after)
    return torch.minimum(torch.maximum(slope, -before - margin), after + margin)


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [M, 3, 3] of quaternions [M, 4] wxyz of any length; zero is the identity.

    The gradient of a zero quaternion is zero.
    """
    # Scaled by its largest part first, a tiny or huge quaternion has a norm. As the rotation does
    # not depend on the length, the scale needs no gradient.
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)  # [M, 1]
    zero = largest < torch.finfo(quats.dtype).tiny ** 0.5
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    scaled = torch.where(zero, identity, quats / largest.masked_fill(zero, 1.0))
    w, x, y, z = normalize(scaled, dim=-1).unbind(-1)
    matrix = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(matrix, dim=-1).reshape(-1, 3, 3)


def squared_radius(opacities: Tensor, settings: RasterSettings) -> Tensor:
    """How far a Gaussian reaches, in sigmas squared: where opacity exp(-r^2 / 2) is alpha_min.

    float64, [M]. Negative where the opacity itself is below the cut.
    """
    # Without a cut-off the reach ends where float64 has no normal numbers left.
    smallest = max(settings.alpha_min, torch.finfo(torch.float64).tiny)
    return 2 * torch.log(opacities.double() / smallest)


def reaches_image(flat: Projected, width: int, height: int, settings: RasterSettings) -> Tensor:
    """Which Gaussians have a box of reach that overlaps the image: [M] bool."""
    r2 = squared_radius(flat.opacities, settings)
    extent = (r2.clamp_min(0)[:, None] * flat.cov[:, [0, 2]]).sqrt()  # [M, 2] px
    low, high = flat.means2d - extent, flat.means2d + extent
    size = torch.tensor([width, height])
    # A covariance that overflows, or is singular for want of dilation, has no inverse.
    usable = torch.isfinite(flat.det) & (flat.det > 0) & torch.isfinite(extent).all(-1)
    return usable & (r2 >= 0) & ((high > 0) & (low < size)).all(-1)


def whitened(flat: Projected) -> Tensor:
    """What a pixel needs to know of a Gaussian's shape: [M, 6] x, y, p, s, q, log(opacity).

    With d the pixel's centre less the mean, u = p dx - s dy and v = q dy are normal deviates over
    sqrt(2), so alpha = opacity exp(-u^2 - v^2): the inverse covariance as a sum of squares.
    """
    _, xy, yy = flat.cov.unbind(-1)
    p = (yy / flat.det / 2).sqrt()
    s = p * xy / yy
    q = (0.5 / yy).sqrt()
    shape = torch.stack([p, s, q, torch.log(flat.opacities)], dim=-1)
    return torch.cat([flat.means2d, shape], dim=-1)


def list_pairs(
    flat: Projected, width: int, height: int, settings: RasterSettings
) -> tuple[Tensor, Tensor]:
    """Every (tile, Gaussian) pair in which some pixel's alpha reaches the cut.

    Exact up to a margin: the ellipse's horizontal span is found for each row of tiles.

    Returns:
        tile [P], ascending, row-major; gaussian [P], ascending (front to back) within a tile.

    Raises:
        MemoryError: P is beyond memory.
    """
    x, y = flat.means2d.double().unbind(-1)
    xx, xy, yy = flat.cov.double().unbind(-1)
    r2 = squared_radius(flat.opacities, settings) + RADIUS_MARGIN
    reach = (r2 * yy).sqrt()
    top = _first_pixel(y - reach, height)
    bottom = _last_pixel(y + reach, height)
    owner, tile_row = _ranges(_div(top), _div(bottom))  # one entry a (Gaussian, row of tiles)

    # The span's ends are the ellipse's leftmost and rightmost points, or as near to them as the
    # row allows (the boundary is concave).
    low = torch.maximum(tile_row * TILE, top[owner]) + 0.5 - y[owner]
    high = torch.minimum(tile_row * TILE + TILE - 1, bottom[owner]) + 0.5 - y[owner]
    tip = ((r2 / xx).sqrt() * xy)[owner]
    right = torch.minimum(torch.maximum(tip, low), high)
    left = torch.minimum(torch.maximum(-tip, low), high)
    slope, width2 = (xy / yy)[owner], (flat.det.double() / yy)[owner]
    half_left = (width2 * (r2[owner] - left * left / yy[owner]).clamp_min(0)).sqrt()
    half_right = (width2 * (r2[owner] - right * right / yy[owner]).clamp_min(0)).sqrt()
    begin = _div(_first_pixel(x[owner] + slope * left - half_left, width))
    end = _div(_last_pixel(x[owner] + slope * right + half_right, width))
    pairs = int((end - begin + 1).clamp_min(0).sum())
    if pairs > MAX_PAIRS:
        raise MemoryError(f"{pairs} (tile, Gaussian) pairs in one view, more than {MAX_PAIRS}")

    entry, tile_column = _ranges(begin, end)
    columns, _ = _tile_counts(width, height)
    tile, by_tile = torch.sort(tile_row[entry] * columns + tile_column, stable=True)
    return tile, owner[entry[by_tile]]


def _first_pixel(position: Tensor, size: int) -> Tensor:
    """The first pixel of 0..size-1 whose centre is not before `position`, `size` if none is."""
    return torch.ceil(position - 0.5).clamp(0, size).long()


def _last_pixel(position: Tensor, size: int) -> Tensor:
    """The last pixel of 0..size-1 whose centre is not after `position`, -1 if none is."""
    return torch.floor(position - 0.5).clamp(-1, size - 1).long()


def _div(pixel: Tensor) -> Tensor:
    return torch.div(pixel, TILE, rounding_mode="floor")


def _ranges(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """All integers of the ranges first..last (inclusive; may be empty), with whose they are.

    Returns:
        owner and value, both [sum of lengths], by owner and then by value.
    """
    lengths = (last - first + 1).clamp_min(0)
    owner = torch.repeat_interleave(lengths)
    starts = torch.cumsum(lengths, 0) - lengths
    return owner, first[owner] + torch.arange(len(owner)) - starts[owner]


def _tile_counts(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover the image."""
    return -(-width // TILE), -(-height // TILE)


def make_batches(
    tile: Tensor, gaussian: Tensor, tiles: int, null: int
) -> tuple[list[Batch], Tensor]:
    """Group all tiles by the length of their lists, longest first, and pad the lists.

    Args:
        tile: [P] ascending.
        gaussian: [P]
        tiles: how many there are; the empty ones are composited too, to their background.
        null: the index that pads.

    Returns:
        The batches, and the padded lists of all, one batch after another: [sum of B K].
    """
    counts = torch.bincount(tile, minlength=tiles)
    starts = torch.cumsum(counts, 0) - counts
    padded = pad(gaussian, (0, 1), value=null)
    by_length = torch.argsort(counts, descending=True, stable=True)
    lengths = counts[by_length].tolist()
    batches, lists, begin = [], [], 0
    while begin < tiles:
        longest = max(1, lengths[begin])
        size = max(1, BATCH_ELEMENTS // (longest * TILE * TILE))
        chosen = by_length[begin : begin + size]
        place = torch.arange(longest)
        inside = place < counts[chosen, None]
        lists.append(padded[torch.where(inside, starts[chosen, None] + place, len(gaussian))])
        batches.append(Batch(chosen, longest))
        begin += size
    return batches, torch.cat([entries.flatten() for entries in lists])


def _composite_batches(
    records: Tensor, batches: list[Batch], index: Tensor, columns: int, settings: RasterSettings
) -> tuple[Tensor, int]:
    """Composite every tile: [tiles, TILE^2, 4] in row-major order, and a batch's peak bytes."""
    null = records.new_tensor([[0.0, 0.0, 0.0, 0.0, 0.0, float("-inf"), 0.0, 0.0, 0.0]])
    listed = embedding(index, torch.cat([records, null]))  # [sum of B K, 9]
    parts = listed.split([len(batch.tiles) * batch.longest for batch in batches])
    outputs = []
    for batch, part in zip(batches, parts, strict=True):
        corner = torch.stack([batch.tiles % columns, batch.tiles // columns], dim=-1) * TILE
        entries = part.reshape(len(batch.tiles), batch.longest, -1)
        # Recomputed in the backward pass: a view's alphas at once would not fit in memory.
        rgba = checkpoint(
            composite,
            entries,
            corner.to(records),
            settings,
            use_reentrant=False,
            preserve_rng_state=False,
        )
        outputs.append(rgba)
    order = torch.argsort(torch.cat([batch.tiles for batch in batches]))
    alphas = max(len(batch.tiles) * batch.longest for batch in batches) * TILE * TILE
    return torch.cat(outputs)[order], _bytes(listed) + alphas * ALPHA_BUFFERS * records.itemsize


ALPHA_BUFFERS = 8
"""Arrays of a batch's alphas that `composite` has at once."""


def composite(entries: Tensor, corner: Tensor, settings: RasterSettings) -> Tensor:
    """Composite tiles front to back.

    A contribution below alpha_min is skipped, one above alpha_max is capped (no gradient), and a
    pixel ends before the Gaussian that would leave it transmittance_min or less.

    Args:
        entries: [B, K, 9] a tile's Gaussians: `whitened` and colour.
        corner: [B, 2] each tile's top left, px.
        settings: the cut-offs.

    Returns:
        [B, TILE^2, 4] colour without background, and alpha.
    """
    x, y, p, s, q, log_opacity = entries[..., :6, None].unbind(-2)  # [B, K, 1] each
    centre = torch.arange(TILE, dtype=entries.dtype) + 0.5
    dx = corner[:, None, :1] + centre - x  # [B, K, TILE]
    dy = corner[:, None, 1:] + centre - y
    u = (p * dx)[:, :, None, :] - (s * dy)[:, :, :, None]  # [B, K, TILE, TILE]
    row = (log_opacity - (q * dy).square())[:, :, :, None]
    alpha = torch.exp(torch.addcmul(row, u, u, value=-1)).clamp_max(settings.alpha_max)
    alpha = alpha.flatten(2)  # [B, K, TILE^2]
    alpha = torch.where(alpha < settings.alpha_min, 0.0, alpha)

    # Never frozen, the product falls on past the end: so what is kept is a prefix, exactly.
    after = torch.cumprod(1 - alpha, dim=1)  # [B, K, TILE^2] transmittance behind each
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weights = torch.where(after > settings.transmittance_min, alpha * before, 0.0)
    colors = pad(entries[..., 6:], (0, 1), value=1.0)  # [B, K, 4]
    return weights.transpose(1, 2) @ colors


def _bytes(*tensors: Tensor) -> int:
    return sum(tensor.nbytes for tensor in tensors)
