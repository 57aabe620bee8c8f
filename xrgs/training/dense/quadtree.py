"""Squares of pixels of even colour: few where a photograph is smooth, many where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xrgs.training.dense.levels import Bools, Doubles, Floats

LEVELS = 5
"""Squares are 1, 2, 4, ... up to 2^5 = 32 px a side; our choice."""

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Leaves:
    """Squares of one view's photograph, L of them."""

    x: Doubles
    """[L] px, the mean place of the chosen pixels of the square."""
    y: Doubles
    pixels: Doubles
    """[L] their number."""
    colors: Doubles
    """[L, 3] in 0..1, their mean colour."""
    nearest: tuple[Indices, Indices]
    """[L] row and column of the chosen pixel that is nearest to the mean place."""


class Quadtree:
    """All squares of the chosen pixels of one photograph, from single pixels upward."""

    def __init__(self, image: Floats, chosen: Bools, weight: float) -> None:
        """Sum up the squares.

        Args:
            image: [H, W, 3] in 0..1.
            chosen: [H, W] the P pixels that count.
            weight: The factor of this photograph's errors.
        """
        self.rows, self.columns = (axis.astype(np.int64) for axis in np.nonzero(chosen))
        self.colors = image[chosen].astype(np.float64)
        self.width = chosen.shape[1]
        self.of_pixels = [self._square_of_pixels(level) for level in range(LEVELS + 1)]
        """For each size the number [P] of the square that each pixel is in."""
        self.errors = [weight * self._errors(squares) for squares in self.of_pixels]
        """For each size the squared differences of the squares' colours from their means."""

    def _square_of_pixels(self, level: int | Indices) -> Indices:
        """The number [P] of the square that each pixel is in, 2^level px a side."""
        # The width is at least the number of squares in a row, whatever their size.
        square: Indices = (self.rows >> level) * self.width + (self.columns >> level)
        return square

    def _errors(self, squares: Indices) -> Doubles:
        number = np.maximum(np.bincount(squares), 1)
        total = np.bincount(squares, np.square(self.colors).sum(axis=1)).astype(np.float64)
        for channel in self.colors.T:
            total = total - np.square(np.bincount(squares, channel)) / number
        return np.maximum(total, 0)

    def roots(self) -> int:
        """The number of the largest squares."""
        return len(np.unique(self.of_pixels[LEVELS]))

    def splits(self) -> tuple[Doubles, Indices]:
        """The error of each square with several pixels, and how many squares its split adds."""
        errors, added = [], []
        for level in range(1, LEVELS + 1):
            _, first = np.unique(self.of_pixels[level - 1], return_index=True)
            number = np.bincount(self.of_pixels[level][first])
            errors.append(self.errors[level][number > 1])
            added.append(number[number > 1] - 1)
        return np.concatenate(errors), np.concatenate(added)

    def leaves(self, limit: float) -> Leaves:
        """Split every square whose error is above a limit; return those that are left.

        A part of a square has no larger error than the square, so that a pixel is in the largest
        square around it that is within the limit.
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
    """The error above which squares are split, so that they are at most as many as a budget.

    Where the largest squares are more than the budget already, nothing is split.
    """
    parts = [tree.splits() for tree in trees]
    errors = np.concatenate([part[0] for part in parts])
    added = np.concatenate([part[1] for part in parts])
    order = np.argsort(-errors, kind="stable")
    total = sum(tree.roots() for tree in trees) + np.cumsum(added[order])
    split = int(np.searchsorted(total, budget, side="right"))  # as many squares can be split
    # The next one stays whole, and so do those with the same error.
    return float(errors[order[split]]) if split < len(order) else 0.0
