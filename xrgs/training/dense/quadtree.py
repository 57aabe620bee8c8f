"""A quadtree of a photograph: large squares where it is smooth, small squares where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xrgs.training.dense.levels import Bools, Doubles, Floats

LEVELS = 5
"""The sides of squares are 1, 2, 4, ... up to 2^5 = 32 px; our choice."""

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Leaves:
    """L squares of one view's photograph. Only the chosen pixels of a square count."""

    x: Doubles
    """[L] mean position of the square's pixels, px."""
    y: Doubles
    pixels: Doubles
    """[L] number of the square's pixels."""
    colors: Doubles
    """[L, 3] mean colour of the square's pixels, in 0..1."""
    nearest: tuple[Indices, Indices]
    """[L] row and column of the pixel nearest to the mean position."""


class Quadtree:
    """All squares of one photograph's chosen pixels, of every size from a single pixel."""

    def __init__(self, image: Floats, chosen: Bools, weight: float) -> None:
        """Compute the errors of all squares of an image [H, W, 3] in 0..1, times `weight`.

        Only the P pixels count that are `chosen` [H, W].
        """
        self.rows, self.columns = (axis.astype(np.int64) for axis in np.nonzero(chosen))
        self.colors = image[chosen].astype(np.float64)
        self.width = chosen.shape[1]
        self.of_pixels = [self._square_of_pixels(level) for level in range(LEVELS + 1)]
        """For each size: [P] number of the square around each pixel."""
        self.errors = [weight * self._errors(squares) for squares in self.of_pixels]
        """For each size: sum of squared differences from the mean colour, for each square."""

    def _square_of_pixels(self, level: int | Indices) -> Indices:
        """Return the number [P] of the square around each pixel, with sides of 2^level px."""
        # The image's width is at least the number of squares in a row, for every size.
        square: Indices = (self.rows >> level) * self.width + (self.columns >> level)
        return square

    def _errors(self, squares: Indices) -> Doubles:
        number = np.maximum(np.bincount(squares), 1)
        total = np.bincount(squares, np.square(self.colors).sum(axis=1)).astype(np.float64)
        for channel in self.colors.T:
            total = total - np.square(np.bincount(squares, channel)) / number
        return np.maximum(total, 0)

    def roots(self) -> int:
        """Return the number of squares of the largest size."""
        return len(np.unique(self.of_pixels[LEVELS]))

    def splits(self) -> tuple[Doubles, Indices]:
        """Return the error of each divisible square, and the number of squares a split adds."""
        errors, added = [], []
        for level in range(1, LEVELS + 1):
            _, first = np.unique(self.of_pixels[level - 1], return_index=True)
            number = np.bincount(self.of_pixels[level][first])
            errors.append(self.errors[level][number > 1])
            added.append(number[number > 1] - 1)
        return np.concatenate(errors), np.concatenate(added)

    def leaves(self, limit: float) -> Leaves:
        """Split all squares with an error above the limit; return the remaining squares.

        The error of a part is at most that of the square. So each pixel belongs to the largest
        square around it whose error is within the limit.
        """
        level = np.zeros(len(self.rows), np.int64)
        for size in range(1, LEVELS + 1):
            level[self.errors[size][self.of_pixels[size]] <= limit] = size
        squares = self._square_of_pixels(level) * (LEVELS + 1) + level
        _, leaf = np.unique(squares, return_inverse=True)
        number = np.bincount(leaf).astype(np.float64)
        y, x, *colors = (
            np.bincount(leaf, values) / number
            for values in (self.rows + 0.5, self.columns + 0.5, *self.colors.T)
        )
        away = np.square(self.columns + 0.5 - x[leaf]) + np.square(self.rows + 0.5 - y[leaf])
        _, first = np.unique(leaf[order := np.lexsort((away, leaf))], return_index=True)
        nearest = self.rows[order[first]], self.columns[order[first]]
        return Leaves(x, y, number, np.stack(colors, axis=-1), nearest)


def limit_for(trees: Sequence[Quadtree], budget: int) -> float:
    """Return the limit for `Quadtree.leaves` that gives at most `budget` leaves of all trees.

    If the largest squares alone exceed the budget, nothing is split.
    """
    parts = [tree.splits() for tree in trees]
    errors = np.concatenate([part[0] for part in parts])
    added = np.concatenate([part[1] for part in parts])
    order = np.argsort(-errors, kind="stable")
    total = sum(tree.roots() for tree in trees) + np.cumsum(added[order])
    split = int(np.searchsorted(total, budget, side="right"))  # number of squares to split
    # The next square, and others with the same error, are not split.
    return float(errors[order[split]]) if split < len(order) else 0.0
