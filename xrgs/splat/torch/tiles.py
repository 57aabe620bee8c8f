"""Which Gaussians each tile of the image has to look at, and which tiles go together."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import Projected, squared_radius

MAX_PAIRS = 1 << 27
"""(tile, Gaussian) pairs that fit in memory: some 80 bytes each, so 10 GB."""

RADIUS_MARGIN = 0.01
"""Added to the squared radius in sigmas when listing, so that rounding never drops a pixel."""


@dataclass(frozen=True)
class Grid:
    """The square tiles that cover an image; the last of a row or column may stand out."""

    width: int  # px
    height: int
    tile: int  # side of a tile, px

    @property
    def columns(self) -> int:
        """Tiles in a row."""
        return -(-self.width // self.tile)

    @property
    def rows(self) -> int:
        """Tiles in a column."""
        return -(-self.height // self.tile)

    def span(self, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        """Columns (or rows) of tiles, first and last, of pixels first..last; none of none."""
        begin = torch.div(first, self.tile, rounding_mode="floor")
        end = torch.div(last, self.tile, rounding_mode="floor")
        return begin, torch.where(last < first, begin - 1, end)

    def corners(self, tiles: Tensor) -> Tensor:
        """Top left [B, 2] x, y in px of tiles [B], numbered row by row."""
        return torch.stack([tiles % self.columns, tiles // self.columns], dim=-1) * self.tile


@dataclass(frozen=True)
class Batch:
    """Tiles composited together, every list padded to the longest."""

    tiles: Tensor  # [B]
    longest: int  # K


def list_pairs(flat: Projected, grid: Grid, settings: RasterSettings) -> tuple[Tensor, Tensor]:
    """Every (tile, Gaussian) pair in which some pixel's alpha reaches the cut.

    A superset, exact but for a margin: the ellipse's horizontal span is found for each row of
    tiles.

    Returns:
        tile [P], ascending, row-major; gaussian [P], ascending (front to back) within a tile.

    Raises:
        MemoryError: P is beyond memory.
    """
    x, y = flat.means2d.double().unbind(-1)
    xx, xy, yy = flat.cov.double().unbind(-1)
    r2 = squared_radius(flat.opacities, settings) + RADIUS_MARGIN
    reach = (r2 * yy).sqrt()
    top = _first_pixel(y - reach, grid.height)
    bottom = _last_pixel(y + reach, grid.height)
    # [R], one entry a (Gaussian, row of tiles)
    owner, tile_row = _ranges(*grid.span(top, bottom))

    # The span's ends are the ellipse's leftmost and rightmost points, or as near to them as the
    # row allows (the boundary is concave).
    low = torch.maximum(tile_row * grid.tile, top[owner]) + 0.5 - y[owner]
    high = torch.minimum(tile_row * grid.tile + grid.tile - 1, bottom[owner]) + 0.5 - y[owner]
    tip = ((r2 / xx).sqrt() * xy)[owner]
    right = torch.minimum(torch.maximum(tip, low), high)
    left = torch.minimum(torch.maximum(-tip, low), high)
    slope, narrow = (xy / yy)[owner], (flat.det.double() / yy)[owner]
    half_left = (narrow * (r2[owner] - left * left / yy[owner]).clamp_min(0)).sqrt()
    half_right = (narrow * (r2[owner] - right * right / yy[owner]).clamp_min(0)).sqrt()
    begin, end = grid.span(
        _first_pixel(x[owner] + slope * left - half_left, grid.width),
        _last_pixel(x[owner] + slope * right + half_right, grid.width),
    )
    pairs = int((end - begin + 1).clamp_min(0).sum())
    if pairs > MAX_PAIRS:
        raise MemoryError(f"{pairs} (tile, Gaussian) pairs in one view, more than {MAX_PAIRS}")

    entry, tile_column = _ranges(begin, end)
    tile, by_tile = torch.sort(tile_row[entry] * grid.columns + tile_column, stable=True)
    return tile, owner[entry[by_tile]]


def _first_pixel(position: Tensor, size: int) -> Tensor:
    """The first pixel of 0..size-1 whose centre is not before `position`, `size` if none is."""
    return torch.ceil(position - 0.5).clamp(0, size).long()


def _last_pixel(position: Tensor, size: int) -> Tensor:
    """The last pixel of 0..size-1 whose centre is not after `position`, -1 if none is."""
    return torch.floor(position - 0.5).clamp(-1, size - 1).long()


def _ranges(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """All integers of the ranges first..last (inclusive; may be empty), with whose they are.

    Returns:
        owner and value, both [sum of lengths], by owner and then by value.
    """
    lengths = (last - first + 1).clamp_min(0)
    owner = torch.repeat_interleave(lengths)
    starts = torch.cumsum(lengths, 0) - lengths
    return owner, first[owner] + torch.arange(len(owner)) - starts[owner]


def make_batches(
    tile: Tensor, gaussian: Tensor, grid: Grid, null: int, elements: int
) -> tuple[list[Batch], Tensor]:
    """Group all tiles by the length of their lists, longest first, and pad the lists.

    Args:
        tile: [P] ascending.
        gaussian: [P]
        grid: the tiles; those with an empty list are grouped too.
        null: the index that pads.
        elements: alpha values that a batch may have, unless one tile alone has more.

    Returns:
        The batches, and the padded lists of all, one batch after another: [sum of B K].
    """
    tiles = grid.columns * grid.rows
    counts = torch.bincount(tile, minlength=tiles)
    starts = torch.cumsum(counts, 0) - counts
    padded = pad(gaussian, (0, 1), value=null)
    by_length = torch.argsort(counts, descending=True, stable=True)
    lengths = counts[by_length].tolist()
    batches, lists, begin = [], [], 0
    while begin < tiles:
        longest = max(1, lengths[begin])
        size = max(1, elements // (longest * grid.tile**2))
        chosen = by_length[begin : begin + size]
        place = torch.arange(longest)
        inside = place < counts[chosen, None]
        lists.append(padded[torch.where(inside, starts[chosen, None] + place, len(gaussian))])
        batches.append(Batch(chosen, longest))
        begin += size
    return batches, torch.cat([entries.flatten() for entries in lists])
