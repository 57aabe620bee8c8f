"""Quadtrees: each chosen pixel is in one leaf, which is even, and budgets are kept."""

from __future__ import annotations

import numpy as np
import pytest

from xrgs.training.dense.quadtree import LEVELS, Quadtree, limit_for


@pytest.fixture
def photograph() -> tuple[np.ndarray, np.ndarray]:
    """An image [50, 70, 3] with an even half and a noisy one, and its chosen pixels."""
    rng = np.random.default_rng(0)
    image = np.full((50, 70, 3), 0.25, np.float32)
    image[:, 35:] = rng.random((50, 35, 3))
    return image, rng.random((50, 70)) < 0.8


@pytest.mark.parametrize("limit", [0.0, 0.5, 1e9])
def test_leaves_hold_every_chosen_pixel_once_with_its_mean_colour(
    photograph: tuple[np.ndarray, np.ndarray], limit: float
) -> None:
    image, chosen = photograph
    leaves = Quadtree(image, chosen, weight=1.0).leaves(limit)
    assert leaves.pixels.sum() == chosen.sum()
    rows, columns = np.nonzero(chosen)
    for of_leaves, of_pixels in ((leaves.x, columns + 0.5), (leaves.y, rows + 0.5)):
        np.testing.assert_allclose((of_leaves * leaves.pixels).sum(), of_pixels.sum())
    colors = (leaves.colors * leaves.pixels[:, None]).sum(axis=0)
    np.testing.assert_allclose(colors, image[chosen].astype(float).sum(axis=0))
    assert chosen[leaves.nearest].all()
    assert (np.abs(leaves.nearest[0] + 0.5 - leaves.y) < 2**LEVELS).all()


def test_even_areas_have_large_leaves_and_uneven_ones_small(
    photograph: tuple[np.ndarray, np.ndarray],
) -> None:
    image, _ = photograph
    leaves = Quadtree(image, np.ones(image.shape[:2], bool), weight=1.0).leaves(1e-6)
    half = Quadtree(*photograph, weight=2.0).leaves(1.0)  # weights multiply errors
    np.testing.assert_array_equal(half.x, Quadtree(*photograph, weight=1.0).leaves(0.5).x)
    # Left of the noise are two columns of whole squares, and one that the noise begins in.
    assert leaves.pixels[leaves.x < 32].max() == 4**LEVELS
    assert (leaves.pixels[leaves.x > 36] == 1).all()


@pytest.mark.parametrize("budget", [1, 300, 10**6])
def test_leaves_are_at_most_the_budget_and_use_it(
    photograph: tuple[np.ndarray, np.ndarray], budget: int
) -> None:
    trees = [Quadtree(*photograph, weight=weight) for weight in (1.0, 3.0)]
    limit = limit_for(trees, budget)
    count = sum(len(tree.leaves(limit).x) for tree in trees)
    assert count <= max(budget, sum(tree.roots() for tree in trees))
    # A split adds three squares at most. Without a limit, all that are uneven are split.
    assert count >= budget - 3 or limit == 0
