"""Leaves panoramas out of the photographs of a folder, since no pinhole camera took them."""

from __future__ import annotations

from collections import defaultdict
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from xrgs.photos import exif, images
from xrgs.photos.scenes.copies import size
from xrgs.photos.scenes.scene import remembered
from xrgs.runtime.text import listed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

#: A picture that is longer for its width than this, and so many times longer than the others, is
#: called a panorama. It would set the size of all others, and SfM can't place it. Our choice.
_PANORAMA, _TIMES = 2.2, 1.6
#: All directions are twice as many degrees around as from below to above.
_ASPECT, _ASPECT_TOLERANCE = 2.0, 0.01
#: The side at which pictures of this shape are looked at, px.
_SIDE = 128
#: In such a picture the left edge goes on at the right: the two differ by no more than this many
#: times what neighbouring columns do. The rows at the top and the bottom, which are a point each,
#: vary by no more than this share of the quarter of rows that vary most (there may be a plain sky).
#: Of 376 ordinary photographs none had the first, and 19 the second.
_MOST_STEP, _MOST_VARIATION = 1.3, 0.4
#: The columns at an edge, and how much they differ at least, as a share of what others do.
_NEAR_EDGE, _LEAST_STEP = 8, 0.4
#: How much the two edges change alike from row to row, and over how many rows: noise does not.
_LEAST_CORRELATION, _ROWS = 0.4, 4


def without_panoramas(files: Sequence[Path], folder: Path) -> tuple[list[Path], list[str]]:
    """Leave out panoramas, and name other pictures of their shape.

    They are told by what their metadata say of the projection, by the picture of all directions,
    and by a shape that the other photographs have not.
    """
    reasons = {file: why for file in files if (why := _projection(file))}
    aspects = {
        file: max(size(file)) / min(size(file))
        for file in files
        if min(size(file)) and file not in reasons
    }
    usual = median(aspects.values()) if aspects else 1.0
    longer = {f for f, a in aspects.items() if a > max(1.1 * usual, min(_PANORAMA, _TIMES * usual))}
    reasons |= {
        f: "left out as panoramas, by their shape"
        for f in longer
        if aspects[f] > max(_PANORAMA, _TIMES * usual)
    }
    others = "longer for their width than others (screenshots, crops?)"
    around = "kept, and perhaps panoramas, since their left edges go on at the right"
    said = dict.fromkeys(longer, others) | reasons
    said |= {file: around for file in files if file not in said and _goes_around(file)}
    named = defaultdict(list)
    for file in sorted(said):
        named[said[file]].append(str(file.relative_to(folder)))
    notes = [f"{why}: {listed(names)}" for why, names in sorted(named.items())]
    return [file for file in files if file not in reasons], notes


@remembered
def _projection(file: Path) -> str:
    """Say why a file is a panorama, whatever the other files are; empty where it is none."""
    try:
        if name := exif.read(file).projection:
            return f"left out as panoramas, by their metadata ({name})"
        if is_of_all_directions(size(file), lambda side: images.thumbnail(file, side)):
            return "left out as panoramas of 360 degrees, by their shape and edges"
    except images.ImageError:
        pass
    return ""


def is_of_all_directions(size: tuple[int, int], small: Callable[[int], NDArray[np.uint8]]) -> bool:
    """Tell by its content whether a picture shows all directions, 360 by 180 degrees.

    Args:
        size: Its width and height, px.
        small: Returns it grey and square [S, S] for a side S; called where it has the shape.
    """
    width, height = size
    if not height or abs(width / height / _ASPECT - 1) > _ASPECT_TOLERANCE:
        return False
    grey = small(_SIDE).astype(np.float64)
    variation = grey.std(axis=1)
    most = _MOST_VARIATION * np.percentile(variation, 75)
    return bool(max(variation[0], variation[-1]) <= most) and _has_one_edge(grey)


@remembered
def _goes_around(file: Path) -> bool:
    """Tell whether a file that is wide enough may show 360 degrees, though not all directions."""
    try:
        width, height = size(file)
        wide = width > (1 - _ASPECT_TOLERANCE) * _ASPECT * height
        return wide and _has_one_edge(images.thumbnail(file, _SIDE).astype(np.float64))
    except images.ImageError:
        return False


def _has_one_edge(grey: NDArray[np.float64]) -> bool:
    """Tell whether the left edge of a picture [S, S] goes on at the right."""
    steps = np.abs(np.diff(grey, axis=1)).mean(axis=0)
    usual = np.median(steps)
    # A plain background goes on at the other side too, but has nothing to tell it by.
    edges = min(steps[:_NEAR_EDGE].mean(), steps[-_NEAR_EDGE:].mean())
    around = np.abs(grey[:, 0] - grey[:, -1]).mean() <= _MOST_STEP * usual
    left, right = (grey[_ROWS:] - grey[:-_ROWS]).T[[0, -1]]
    alike = left @ right > _LEAST_CORRELATION * np.sqrt(left @ left * (right @ right))
    return bool(usual > 0 and around and edges >= _LEAST_STEP * usual and alike)
