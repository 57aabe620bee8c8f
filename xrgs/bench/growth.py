"""Fits how the time of a render grows with the number of Gaussians and with that of pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

Row = dict[str, Any]


class Growth(NamedTuple):
    """The times of loads that differ in one size only, and the power law through them."""

    fixed: str
    """The other size, which they have in common."""
    sizes: tuple[float, ...]
    """What grows, ascending."""
    ms: tuple[float, ...]
    """Forward and backward time at each size."""
    exponent: float
    """Of the power law; 1 means that twice as many take twice as long."""


def fit_exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Fit the power law times = a sizes^exponent by least squares of the logarithms.

    Args:
        sizes: At least two different sizes, above 0.
        times: The time at each size, above 0.

    Returns:
        The exponent.
    """
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def fit_growth(rows: Sequence[Row], method: str, count: int) -> dict[str, float]:
    """Fit how the forward and backward time grows with Gaussians and pixels together.

    Args:
        rows: Rows of random loads, as `rendering.time_load` gives them.
        method: Name of the method whose rows are used.
        count: Number of threads of the rows that are used.

    Returns:
        The exponents `gaussians` and `pixels` of a power law, fitted by least squares to the
        logarithms; 1 means that twice as many take twice as long. Empty unless the loads differ in
        both.
    """
    used = _rows_of(rows, method, count)
    numbers = np.array([(row["gaussians"], _pixels(row)) for row in used], float)
    numbers = numbers.reshape(-1, 2)  # also if there are no rows
    if len(np.unique(numbers[:, 0])) < 2 or len(np.unique(numbers[:, 1])) < 2:
        return {}
    design = np.column_stack([np.log(numbers), np.ones(len(used))])
    exponents = np.linalg.lstsq(design, np.log([_ms(row) for row in used]), rcond=None)[0]
    return {"gaussians": float(exponents[0]), "pixels": float(exponents[1])}


def growth_by_gaussians(rows: Sequence[Row], method: str, count: int) -> list[Growth]:
    """Fit how the time grows with the number of Gaussians, at each size of the image.

    Args:
        rows: Rows of random loads, as `rendering.time_load` gives them.
        method: Name of the method whose rows are used.
        count: Number of threads of the rows that are used.

    Returns:
        The growth at each size that at least two loads have, the smallest first.
    """
    used = sorted(_rows_of(rows, method, count), key=_pixels)
    groups: dict[str, list[Row]] = {}
    for row in used:
        groups.setdefault(f"{row['width']}x{row['height']}", []).append(row)
    return _fits(
        {fixed: [(row["gaussians"], _ms(row)) for row in group] for fixed, group in groups.items()}
    )


def growth_by_pixels(rows: Sequence[Row], method: str, count: int) -> list[Growth]:
    """Fit how the time grows with the number of pixels, for each number of Gaussians.

    Args:
        rows: Rows of random loads, as `rendering.time_load` gives them.
        method: Name of the method whose rows are used.
        count: Number of threads of the rows that are used.

    Returns:
        The growth for each number of Gaussians that at least two loads have, the lowest first.
    """
    used = sorted(_rows_of(rows, method, count), key=lambda row: int(row["gaussians"]))
    groups: dict[str, list[Row]] = {}
    for row in used:
        groups.setdefault(f"{row['gaussians']:,}", []).append(row)
    return _fits(
        {fixed: [(_pixels(row), _ms(row)) for row in group] for fixed, group in groups.items()}
    )


def _fits(groups: dict[str, list[tuple[float, float]]]) -> list[Growth]:
    found = []
    for fixed, points in groups.items():
        if len({size for size, _ in points}) > 1:
            sizes, times = zip(*sorted(points), strict=True)
            found.append(Growth(fixed, sizes, times, fit_exponent(sizes, times)))
    return found


def _rows_of(rows: Sequence[Row], method: str, count: int) -> list[Row]:
    return [row for row in rows if row["method"] == method and row["threads"] == count]


def _pixels(row: Row) -> int:
    return int(row["width"] * row["height"])


def _ms(row: Row) -> float:
    return float(row["forward_ms"] + row["backward_ms"])
