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
#: vary by no more than this share of the others. Of 240 ordinary photographs none had both.
_MOST_STEP, _MOST_VARIATION = 1.5, 0.4
#: The columns at an edge, and how much they differ at least, as a share of what others do.
_NEAR_EDGE, _LEAST_STEP = 8, 0.4


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
    named = defaultdict(list)
    for file in sorted(longer | reasons.keys()):
        named[reasons.get(file, others)].append(str(file.relative_to(folder)))
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
    steps = np.abs(np.diff(grey, axis=1)).mean(axis=0)
    variation = grey.std(axis=1)
    usual = np.median(variation)
    around = np.abs(grey[:, 0] - grey[:, -1]).mean() <= _MOST_STEP * np.median(steps)
    # A plain background goes on at the other side too, but has nothing to tell it by.
    edges = min(steps[:_NEAR_EDGE].mean(), steps[-_NEAR_EDGE:].mean())
    has_edges = edges >= _LEAST_STEP * np.median(steps)
    poles = max(variation[0], variation[-1]) <= _MOST_VARIATION * usual
    return bool(usual > 0 and around and has_edges and poles)
