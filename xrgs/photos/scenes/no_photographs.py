"""Leaves out images that are no photographs of a pinhole camera.

They were made from photographs, as masks and depth maps are, or are panoramas.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from xrgs.photos import exif, images
from xrgs.photos.masks import WORDS
from xrgs.photos.scenes.copies import size
from xrgs.photos.scenes.scene import remembered
from xrgs.runtime.text import listed
from xrgs.safeio.sanitize import counted

#: Words that programs add before or after a photograph's name in the name of an image made of it.
_ADDED = rf"(?:{WORDS}|depth|disparity|normals?|thumb|thumbnail)"
_ADDED_BEFORE = re.compile(rf"^{_ADDED}[\W_]?")
_ADDED_AFTER = re.compile(rf"[\W_]?{_ADDED}(?:[\W_]?\d+)?$")
_SEPARATOR = re.compile(r"[\W_]+")
#: An image of three channels is a mask if more than this share of its values is 0 or 1.
_SHARE_OF_ENDS = 0.95
#: A picture is a panorama if its aspect ratio is above _PANORAMA, and above _TIMES the others'
#: median. It would set the size of all others, and SfM can't place it. Our choice.
_PANORAMA, _TIMES = 2.2, 1.6
#: The aspect ratio of a picture of all directions, 360 x 180 degrees, and its relative tolerance.
_ASPECT, _ASPECT_TOLERANCE = 2.0, 0.01
#: The side of the thumbnails by which such pictures are tested, px.
_SIDE = 128
#: In such a picture the left edge continues at the right: the two edge columns differ at most
#: _MOST_STEP times as much as neighbouring columns. The top and the bottom row show one point each:
#: their deviation is at most _MOST_VARIATION of the rows' upper quartile (the sky may be plain). Of
#: 376 ordinary photographs none met the first condition, and 19 the second.
_MOST_STEP, _MOST_VARIATION = 1.3, 0.4
#: How many columns at each edge must have texture, and its least amount: the mean difference of
#: neighbouring columns there, relative to the median one.
_NEAR_EDGE, _LEAST_STEP = 8, 0.4
#: The least correlation of the two edges' changes over _ROWS rows: noise has none.
_LEAST_CORRELATION, _ROWS = 0.4, 4


def without_made(files: Sequence[Path], folder: Path) -> tuple[list[Path], list[str]]:
    """Leave out images that were made of photographs, with notes.

    Images that xrgs wrote are kept if there are no others.
    """
    own = {file for file in files if _is_own(file)}
    if len(own) == len(files):
        own = set()
    made = _made_of_others([file for file in files if file not in own])
    notes = [
        f"{counted(len(left), 'image')} left out, {why}: "
        + listed([str(file.relative_to(folder)) for file in sorted(left)])
        for left, why in (
            (own, "which xrgs made"),
            (made, "which are masks, depth maps or thumbnails by name or channels"),
        )
        if left
    ]
    made |= own
    return [file for file in files if file not in made], notes


@remembered
def _is_own(file: Path) -> bool:
    try:
        return file.suffix.lower() == ".png" and images.is_own(file)
    except images.ImageError:
        return False


@remembered
def is_mask(file: Path) -> bool:
    """Return whether an image has one channel, or nearly all of its values are 0 or 1."""
    try:
        pixels = None if not images.has_colour(file) else images.decode(file).pixels
    except images.ImageError:
        return False
    return pixels is None or bool(np.mean((pixels == 0) | (pixels == 1)) > _SHARE_OF_ENDS)


def _made_of_others(files: Sequence[Path]) -> set[Path]:
    """Find masks, depth maps and thumbnails by the names of their photographs.

    Beside `a.jpg`, these are `a.jpg.png` and `a_mask.png`; and `a.png` or `a_x.png` if they have
    one channel or two values and `a.jpg` does not. Only the first image of a folder, or of those
    with the same addition to the name, is decoded; it stands for the others.
    """
    named = defaultdict(list)
    for file in files:
        named[file.stem.casefold()].append(file)
    names = {file.name.casefold(): file for file in files}
    known = names | {stem: group[0] for stem, group in named.items()}
    made = set[Path]()
    extended: dict[tuple[Path, str], list[tuple[Path, Path]]] = defaultdict(list)
    for stem, group in named.items():
        plain = {_ADDED_BEFORE.sub("", stem), _ADDED_AFTER.sub("", stem)} - {stem}
        of_whole_name = stem in names and names[stem] not in group  # not itself, without suffix
        if of_whole_name or plain & known.keys():
            made |= {*group}
            continue
        for part, rest in _parts(stem):
            if part in known:
                extended[group[0].parent, rest] += [(file, known[part]) for file in group]
    for pairs in extended.values():
        if is_mask(pairs[0][0]) and not is_mask(pairs[0][1]):
            made |= {file for file, _ in pairs}
    by_folder = defaultdict(list)
    for file in files:
        if len(named[file.stem.casefold()]) > 1 and file not in made:
            by_folder[file.parent, file.suffix.lower()].append(file)
    masks = {file for group in by_folder.values() if is_mask(group[0]) for file in group}
    same_name = {file for group in by_folder.values() for file in group}
    return made if masks == same_name else made | masks


def _parts(stem: str) -> Iterator[tuple[str, str]]:
    """Split a name at each separator; yield each part, and the rest with the separator."""
    for found in _SEPARATOR.finditer(stem):
        yield stem[: found.start()], stem[found.start() :]
        yield stem[found.end() :], stem[: found.end()]


def without_panoramas(files: Sequence[Path], folder: Path) -> tuple[list[Path], list[str]]:
    """Leave out panoramas, and name other pictures of their shape.

    A panorama is recognised by the projection in its metadata, by a picture of all directions, or
    by a shape unlike the other photographs'.
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
    """Say why a file is a panorama, by its metadata or content; empty if it is none."""
    try:
        if name := exif.read(file).projection:
            return f"left out as panoramas, by their metadata ({name})"
        if is_of_all_directions(size(file), lambda side: images.thumbnail(file, side)):
            return "left out as panoramas of 360 degrees, by their shape and edges"
    except images.ImageError:
        pass
    return ""


def is_of_all_directions(size: tuple[int, int], small: Callable[[int], NDArray[np.uint8]]) -> bool:
    """Return whether a picture shows all directions, 360 by 180 degrees, by its shape and edges.

    `small` returns the picture in grey, [S, S], for a side S; it is called only if the shape fits.
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
    """Return whether a wide picture may show 360 degrees around, by its edges."""
    try:
        width, height = size(file)
        wide = width > (1 - _ASPECT_TOLERANCE) * _ASPECT * height
        return wide and _has_one_edge(images.thumbnail(file, _SIDE).astype(np.float64))
    except images.ImageError:
        return False


def _has_one_edge(grey: NDArray[np.float64]) -> bool:
    """Return whether the left edge of a picture [S, S] continues at the right."""
    steps = np.abs(np.diff(grey, axis=1)).mean(axis=0)
    usual = np.median(steps)
    # The edges must have texture: any plain background continues at the other side.
    edges = min(steps[:_NEAR_EDGE].mean(), steps[-_NEAR_EDGE:].mean())
    around = np.abs(grey[:, 0] - grey[:, -1]).mean() <= _MOST_STEP * usual
    left, right = (grey[_ROWS:] - grey[:-_ROWS]).T[[0, -1]]
    alike = left @ right > _LEAST_CORRELATION * np.sqrt(left @ left * (right @ right))
    return bool(usual > 0 and around and edges >= _LEAST_STEP * usual and alike)
