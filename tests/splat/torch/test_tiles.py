"""The lists of tiles against the pixels of each ellipse, one by one."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.splat.scenes import make_camera, make_scene
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch import tiles
from xrgs.splat.torch.projection import ProjectedGaussians, project, visible_by_depth
from xrgs.splat.torch.tiles import TileGrid, build_tile_batches, intersect_tiles


def make_projected(
    width: int, height: int, *, count: int = 60, seed: int = 0
) -> ProjectedGaussians:
    """Projected Gaussians in depth order, of all shapes from specks to needles."""
    camera = make_camera(width, height)
    scene = make_scene(count, camera, seed=seed, size=2.0)
    scene["scales"][::4, 0] *= 20
    scene["scales"][1::4] *= 0.01
    scene["opacities"][::5] *= 0.1
    shape = scene["means"], scene["quats"], scene["scales"], scene["opacities"]
    projected = project(*shape, camera, RasterSettings())
    order = visible_by_depth(projected, camera, RasterSettings())
    return projected._replace(**{k: v[order] for k, v in projected._asdict().items()})


def contributing(projected: ProjectedGaussians, grid: TileGrid) -> set[tuple[int, int]]:
    """The (tile, Gaussian) pairs of all pixels whose alpha reaches alpha_min."""
    row, column = torch.meshgrid(torch.arange(grid.height), torch.arange(grid.width), indexing="ij")
    tile = (row // grid.tile) * grid.columns + column // grid.tile
    pairs: set[tuple[int, int]] = set()
    for i in range(len(projected.depths)):
        xx, xy, yy = projected.cov[i]
        conic = torch.linalg.inv(torch.stack([xx, xy, xy, yy]).reshape(2, 2))
        d = torch.stack([column + 0.5, row + 0.5], dim=-1) - projected.means2d[i]
        exponent = -0.5 * torch.einsum("hwi,ij,hwj->hw", d, conic, d)
        alpha = projected.opacities[i] * torch.exp(exponent)
        pairs |= {(t, i) for t in set(tile[alpha >= RasterSettings().alpha_min].tolist())}
    return pairs


@pytest.mark.parametrize("tile", [4, 8, 16])
@pytest.mark.parametrize(("width", "height"), [(40, 30), (64, 48), (1, 1), (33, 1), (3, 50)])
def test_lists_hold_all_that_contributes_and_little_else(
    width: int, height: int, tile: int
) -> None:
    grid = TileGrid(width, height, tile)
    projected = make_projected(width, height)
    tile_of, gaussian = intersect_tiles(projected, grid, RasterSettings())
    pairs = list(zip(tile_of.tolist(), gaussian.tolist(), strict=True))
    assert pairs == sorted(set(pairs)), "by tile, then front to back, none twice"
    needed = contributing(projected, grid)
    assert needed <= set(pairs)
    assert len(pairs) <= 1.1 * len(needed) + 10


def test_without_a_cut_every_tile_lists_every_gaussian() -> None:
    grid = TileGrid(40, 30, 8)
    projected = make_projected(40, 30)
    tile, gaussian = intersect_tiles(projected, grid, RasterSettings(alpha_min=0.0))
    # Without alpha_min the ellipse ends where alpha is exp(-708): only specks beyond 37 standard
    # deviations may be left out.
    assert len(tile) > 0.3 * grid.columns * grid.rows * len(projected.depths)
    assert set(gaussian.tolist()) == set(range(len(projected.depths)))


def test_too_many_pairs_is_an_error_before_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "MAX_PAIRS", 10)
    with pytest.raises(MemoryError, match=r"pairs in one view, more than 10"):
        intersect_tiles(make_projected(40, 30), TileGrid(40, 30, 8), RasterSettings())


@given(
    lengths=st.lists(st.integers(0, 9), min_size=6, max_size=6),
    elements=st.integers(1, 2000),
)
@settings(max_examples=100)
def test_batches_hold_each_tile_once_with_its_list(lengths: list[int], elements: int) -> None:
    grid = TileGrid(24, 16, 8)
    tile = torch.repeat_interleave(torch.tensor(lengths))
    gaussian = torch.arange(len(tile)) % 7
    null = 99
    batches, index = build_tile_batches(tile, gaussian, grid, null, elements)
    found, begin = {}, 0
    for batch in batches:
        size = len(batch.tiles) * batch.longest
        assert len(batch.tiles) == 1 or size * 64 <= elements
        lists = index[begin : begin + size].reshape(-1, batch.longest)
        begin += size
        for number, entries in zip(batch.tiles.tolist(), lists.tolist(), strict=True):
            assert number not in found
            found[number] = [entry for entry in entries if entry != null]
    assert begin == len(index)
    assert found == {t: gaussian[tile == t].tolist() for t in range(6)}


def test_corners() -> None:
    grid = TileGrid(20, 9, 8)
    assert (grid.columns, grid.rows) == (3, 2)
    corners = grid.corners(torch.arange(6)).tolist()
    assert corners == [[0, 0], [8, 0], [16, 0], [0, 8], [8, 8], [16, 8]]
