"""Lists of the Gaussians in each tile of the image, and batches of tiles.

The tiles of 3D Gaussian Splatting [kerbl2023, section 6] (gsplat's `_isect_tiles`). gsplat lists
every tile that the bounding box of a Gaussian overlaps; here only those that its ellipse overlaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import ProjectedGaussians, cutoff_radius_sq

MAX_PAIRS = 1 << 27
"""Largest number of (tile, Gaussian) pairs in a view: 10 GB, at about 80 bytes each."""

RADIUS_MARGIN = 0.01
"""Added to the squared cutoff radius (in standard deviations), so that rounding drops no pixel."""


@dataclass(frozen=True)
class TileGrid:
    """The square tiles that cover an image; the last row and column may overhang it."""

    width: int  # px
    height: int  # px
    tile: int  # side of a tile, px

    @property
    def columns(self) -> int:
        """Number of tiles in a row."""
        return -(-self.width // self.tile)

    @property
    def rows(self) -> int:
        """Number of tiles in a column."""
        return -(-self.height // self.tile)

    def span(self, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        """Convert ranges of pixels to ranges of tile columns (or rows).

        First and last, [R] each, are in the range; the last is below the first if it is empty.
        """
        begin = torch.div(first, self.tile, rounding_mode="floor")
        end = torch.div(last, self.tile, rounding_mode="floor")
        return begin, torch.where(last < first, begin - 1, end)

    def corners(self, tiles: Tensor) -> Tensor:
        """Return the top left corners [B, 2] (x, y, px) of tiles [B], numbered row by row."""
        return torch.stack([tiles % self.columns, tiles // self.columns], dim=-1) * self.tile


@dataclass(frozen=True)
class TileBatch:
    """Tiles that are composited together, with lists padded to the longest one."""

    tiles: Tensor  # [B] numbers of the tiles
    longest: int  # K, length of the lists


def intersect_tiles(
    projected: ProjectedGaussians, grid: TileGrid, settings: RasterSettings
) -> tuple[Tensor, Tensor]:
    """List the (tile, Gaussian) pairs in which the alpha of a pixel reaches alpha_min.

    A few more pairs are listed, because of `RADIUS_MARGIN`. The ellipse's horizontal extent is
    computed for each row of tiles. The Gaussians are the visible ones, front to back.

    Returns:
        tile: [P] ascending, numbered row by row.
        gaussian: [P] ascending (front to back) within a tile.

    Raises:
        MemoryError: P is more than `MAX_PAIRS`.
    """
    x, y = projected.means2d.double().unbind(-1)  # [M] each
    xx, xy, yy = projected.cov.double().unbind(-1)
    radius_sq = cutoff_radius_sq(projected.opacities, settings) + RADIUS_MARGIN
    half_height = (radius_sq * yy).sqrt()
    top = _first_pixel(y - half_height, grid.height)
    bottom = _last_pixel(y + half_height, grid.height)
    # [R], one entry for each pair of a Gaussian and a row of tiles.
    gaussian, tile_row = _expand_ranges(*grid.span(top, bottom))

    # The ellipse is convex: its extent in a row of tiles ends at its leftmost and rightmost points
    # or, if these are outside the row, at the row's border next to them.
    top_dy = torch.maximum(tile_row * grid.tile, top[gaussian]) + 0.5 - y[gaussian]
    last_row = tile_row * grid.tile + grid.tile - 1
    bottom_dy = torch.minimum(last_row, bottom[gaussian]) + 0.5 - y[gaussian]
    dy_at_xmax = ((radius_sq / xx).sqrt() * xy)[gaussian]
    right_dy = torch.minimum(torch.maximum(dy_at_xmax, top_dy), bottom_dy)
    left_dy = torch.minimum(torch.maximum(-dy_at_xmax, top_dy), bottom_dy)
    # At height dy the ellipse is centred at slope * dy; its half width follows from `variance`.
    slope, variance = (xy / yy)[gaussian], (projected.det.double() / yy)[gaussian]
    radius_sq, yy = radius_sq[gaussian], yy[gaussian]
    left_width = (variance * (radius_sq - left_dy * left_dy / yy).clamp_min(0)).sqrt()
    right_width = (variance * (radius_sq - right_dy * right_dy / yy).clamp_min(0)).sqrt()
    begin, end = grid.span(
        _first_pixel(x[gaussian] + slope * left_dy - left_width, grid.width),
        _last_pixel(x[gaussian] + slope * right_dy + right_width, grid.width),
    )
    pairs = int((end - begin + 1).clamp_min(0).sum())
    if pairs > MAX_PAIRS:
        raise MemoryError(f"{pairs} (tile, Gaussian) pairs in one view, more than {MAX_PAIRS}")

    entry, tile_column = _expand_ranges(begin, end)  # [P]
    tile, by_tile = torch.sort(tile_row[entry] * grid.columns + tile_column, stable=True)
    return tile, gaussian[entry[by_tile]]


def _first_pixel(position: Tensor, size: int) -> Tensor:
    """Return the first pixel of 0..size-1 whose centre is at or after `position`, else `size`."""
    return torch.ceil(position - 0.5).clamp(0, size).long()


def _last_pixel(position: Tensor, size: int) -> Tensor:
    """Return the last pixel of 0..size-1 whose centre is at or before `position`, else -1."""
    return torch.floor(position - 0.5).clamp(-1, size - 1).long()


def _expand_ranges(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Return all integers of the ranges first..last (inclusive; may be empty).

    Returns:
        Index of the range of each integer, and the integer: both [sum of lengths], in the order of
        the ranges and ascending within each.
    """
    lengths = (last - first + 1).clamp_min(0)
    index = torch.repeat_interleave(lengths)
    starts = torch.cumsum(lengths, 0) - lengths
    return index, first[index] + torch.arange(len(index)) - starts[index]


def build_tile_batches(
    tile: Tensor, gaussian: Tensor, grid: TileGrid, padding: int, elements: int
) -> tuple[list[TileBatch], Tensor]:
    """Group all tiles into batches by the length of their lists, longest first; pad the lists.

    Args:
        tile: [P] tiles of the pairs, ascending.
        gaussian: [P] Gaussians of the pairs.
        grid: The tiles of the image; tiles with an empty list are grouped too.
        padding: Gaussian index with which the lists are padded.
        elements: Largest number of alpha values in a batch; a batch of one tile may have more.

    Returns:
        The batches, and their padded lists one after another: [sum of B K].
    """
    tiles = grid.columns * grid.rows
    counts = torch.bincount(tile, minlength=tiles)  # [tiles]
    starts = torch.cumsum(counts, 0) - counts
    padded = pad(gaussian, (0, 1), value=padding)  # [P + 1]
    by_length = torch.argsort(counts, descending=True, stable=True)
    lengths = counts[by_length].tolist()
    batches, lists, begin = [], [], 0
    while begin < tiles:
        longest = max(1, lengths[begin])
        size = max(1, elements // (longest * grid.tile**2))
        batch_tiles = by_length[begin : begin + size]  # [B]
        place = torch.arange(longest)  # [K]
        in_list = place < counts[batch_tiles, None]  # [B, K]
        pair = torch.where(in_list, starts[batch_tiles, None] + place, len(gaussian))
        lists.append(padded[pair])
        batches.append(TileBatch(batch_tiles, longest))
        begin += size
    return batches, torch.cat([indices.flatten() for indices in lists])
