"""Leaves out images that programs made from photographs, such as masks and depth maps."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xrgs.photos import images
from xrgs.photos.masks import WORDS
from xrgs.photos.scenes.scene import remembered
from xrgs.runtime.text import listed
from xrgs.safeio.sanitize import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

#: Words that programs add before or after a photograph's name in the name of an image made of it.
_ADDED = rf"(?:{WORDS}|depth|disparity|normals?|thumb|thumbnail)"
_ADDED_BEFORE = re.compile(rf"^{_ADDED}[\W_]?")
_ADDED_AFTER = re.compile(rf"[\W_]?{_ADDED}(?:[\W_]?\d+)?$")
_SEPARATOR = re.compile(r"[\W_]+")
#: An image of three channels is a mask if more than this share of its values is 0 or 1.
_SHARE_OF_ENDS = 0.95


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
