"""Finds photographs that a folder has twice: byte for byte, in several sizes, in several formats.

A held-out view must not be trained on through its copy. One file of each photograph is taken, and
notes name the others.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence, Set
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xrgs.photos import images
from xrgs.photos.scenes.scene import content, remembered
from xrgs.runtime.text import listed

#: The names of LLFF's folders of one set of photographs: `images`, and `images_N`, N times smaller.
SIZES = re.compile(r"images(?:_(\d+))?")
#: The largest relative deviation of N from the ratio of the sizes; converters round to whole px.
_RATIO_TOLERANCE = 0.05
#: How many pairs of files are compared to find whether two folders have the same photographs.
_SAMPLES = 3
#: The sides of fine and coarse thumbnails, px. In seven captures, neighbouring views have a
#: correlation of 0.979 or less on fine ones, and of up to 0.997 on coarse ones. Photographs that
#: were resized to 334 px and compressed anew have 0.997 or more on fine ones; resized to 80 px,
#: 0.994 or more on coarse ones, and in their own size 0.9998. Fine ones decide whether two folders
#: have the same photographs. Coarse ones decide for each pair of such folders, and for each pair of
#: related names in one folder.
_FINE, _COARSE = 64, 16
#: Two files show one photograph if their thumbnails have at least this correlation: for files of
#: different sizes, and of one size.
_LEAST_ALIKE, _LEAST_ALIKE_SIZE = 0.985, 0.9995
#: The same for files of one folder whose names differ only in suffix or by a phone's edit mark.
_LEAST_ALIKE_TWINS = 0.9
#: The edit mark in names of an iPhone: `IMG_E1234` is the edited `IMG_1234`.
_EDITED = re.compile(r"(?<=^img_)e(?=\d)")
#: The largest deviation of the aspect ratio of a resized copy.
_ASPECT_TOLERANCE = 0.02
#: The end mark of a file's format is searched in this many last bytes.
_TAIL_BYTES = 1 << 10
_END_MARKS = {".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9", ".png": b"IEND"}


@remembered
def size(file: Path) -> tuple[int, int]:
    """Return width and height of a photograph, px; zeros if its header can't be read."""
    try:
        return images.size(file)
    except images.ImageError:
        return 0, 0


@remembered
def _is_whole(file: Path) -> bool:
    """Return whether a file is complete: by its end mark, or else by decoding it."""
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - _TAIL_BYTES))
        tail = stream.read()
    if (mark := _END_MARKS.get(file.suffix.lower())) and mark in tail:
        return size(file) != (0, 0)
    return _thumbnail(file) is not None  # telephones append films to JPEGs


@remembered
def _thumbnail(file: Path) -> NDArray[np.float64] | None:
    """Return a grey thumbnail [_FINE, _FINE]; None if the file can't be read."""
    try:
        return np.asarray(images.thumbnail(file, _FINE), np.float64)
    except images.ImageError:
        return None


def one_of_each_size(
    folders: Sequence[Sequence[Path]], long_side: int
) -> tuple[list[Sequence[Path]], list[str]]:
    """Choose one folder for each set of photographs that LLFF's folders have in several sizes.

    The smallest size that suffices for `variant.long_side`, px, is taken; the largest if none does,
    or if this is 0. A folder that lacks photographs is not taken. Folders whose sizes don't differ
    by the factor in their names are different sets.

    Returns:
        The photographs of each set, and notes.
    """
    groups: list[list[Sequence[Path]]] = []
    for files in sorted(folders, key=_factor):
        group = next((group for group in groups if _are_sizes(group[0], files)), None)
        groups.append([files]) if group is None else group.append(files)
    taken, notes = [], []
    for group in groups:
        counts = {files[0].parent.name: sum(map(_is_whole, files)) for files in group}
        most = max(counts.values())
        complete = [files for files in group if counts[files[0].parent.name] == most]
        by_side = sorted(((_long_side(files), files) for files in complete), key=lambda c: c[0])
        sufficient = [files for side, files in by_side if long_side and side >= long_side]
        choice = sufficient[0] if sufficient else by_side[-1][1]
        taken.append(choice)
        name = choice[0].parent.name
        notes += [
            f"{other} has {count} of the {most} photographs of {name}, so that it is not taken: was"
            " its conversion interrupted?"
            for other, count in counts.items()
            if count < most
        ]
        if len(group) > 1:
            notes.append(f"{listed([*counts])} are copies in several sizes: {name} is taken")
    return taken, notes


def _factor(files: Sequence[Path]) -> int:
    """Return the N of `images_N`, 1 for `images`."""
    match = SIZES.fullmatch(files[0].parent.name)
    return int(match[1] or 1) if match else 1


def _are_sizes(large: Sequence[Path], small: Sequence[Path]) -> bool:
    """Return whether the sizes of two folders differ by the factor in the folders' names.

    Files are paired by name; LLFF's own copies have other names, so that all are compared then.
    """
    named = {file.stem: file for file in large if _is_whole(file)}
    both = [file for file in small if file.stem in named and _is_whole(file)]
    large_side = _long_side([named[file.stem] for file in both] or large)
    small_side = _long_side(both or small)
    if not (large_side and small_side):
        return True  # nothing there can be read, so that the folder is not complete
    expected = _factor(small) / max(1, _factor(large))
    return abs(large_side / small_side - expected) < _RATIO_TOLERANCE * expected


def _long_side(files: Iterable[Path]) -> int:
    return max(max(size(file)) for file in files)


def without_copies(
    files: Sequence[Path], folder: Path, other_sizes: Sequence[Path] = ()
) -> tuple[list[Path], list[str]]:
    """Leave out files that show the same photograph as another one.

    These are compared: files of the same bytes; files of one folder with names such as `a.jpg`,
    `a.png`, `a_small.jpg` and `a (1).jpg`; files of one name in two folders; and files at the same
    place in two folders with equally many files. Copies of `other_sizes`, which were left out for
    another size, are left out, too.

    Returns:
        The files in their order, and notes, with paths relative to `folder`.
    """
    same = _identical(files, frozenset(other_sizes))
    left = [file for file in files if file not in same]
    alike: dict[Path, Path] = {}
    for a, b in (*_of_one_folder(left), *_of_two_folders(left)):
        copy, original = sorted((a, b), key=_preference, reverse=True)
        if copy not in alike and original not in alike and _show_the_same(a, b):
            alike[copy] = original
    notes = []
    for what, pairs in (
        ("identical copies (the same bytes)", same),
        ("copies in another size or format (the same picture)", alike),
    ):
        if pairs:
            names = [
                f"{copy.relative_to(folder)} (of {original.relative_to(folder)})"
                for copy, original in sorted(pairs.items())
            ]
            notes.append(f"{len(pairs)} left out as {what}: {listed(names)}")
    return [file for file in left if file not in alike], notes


def _identical(files: Sequence[Path], known: Set[Path]) -> dict[Path, Path]:
    """Map each file with the same bytes as another, or as a `known` one, to that file."""
    by_length = defaultdict(list)
    for file in (*known, *files):
        by_length[file.stat().st_size].append(file)
    by_length.pop(0, None)  # an empty file is no photograph, and is named when it is read
    by_content = defaultdict(list)
    for group in by_length.values():
        for file in group if len(group) > 1 else ():
            by_content[content(file)].append(file)
    found: dict[Path, Path] = {}
    for group in by_content.values():
        original, *copies = sorted(group, key=lambda file: (file not in known, *_shortest(file)))
        found |= {copy: original for copy in copies if copy not in known}
    return found


def _shortest(file: Path) -> tuple[int, str]:
    """Sort `IMG_1.jpg` before `IMG_1 (1).jpg` and `Copy of IMG_1.jpg`."""
    return len(str(file)), str(file)


def _preference(file: Path) -> tuple[object, ...]:
    """Return a sort key: larger files first, then formats other than HEIC, then short names."""
    width, height = size(file)
    return -width * height, _is_heic(file), *_shortest(file)


def _of_one_folder(files: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Pair files of one folder whose names differ only in suffix, or by an addition."""
    named = defaultdict(list)
    for file in files:
        named[file.parent, file.stem.casefold()].append(file)
    pairs = [pair for group in named.values() for pair in combinations(group, 2)]
    stems = defaultdict(set)
    for parent, stem in named:
        stems[parent].add(stem)
    for (parent, stem), group in named.items():
        # A name is only cut between words and numbers: `IMG_1` is no part of `IMG_10`.
        cuts = [i for i in range(1, len(stem)) if _kind(stem[i - 1]) != _kind(stem[i])]
        parts = {part for i in cuts for part in (stem[:i], stem[i:])} | {_EDITED.sub("", stem)}
        parts.discard(stem)
        for part in parts & stems[parent]:
            pairs += [(a, b) for a in named[parent, part] for b in group]
    return pairs


def _kind(char: str) -> tuple[bool, bool]:
    return char.isalpha(), char.isdigit()


def _of_two_folders(files: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Pair files by name, or by their place in the order, in folders of the same photographs.

    Since cameras number their photographs alike, the first, middle and last pair are compared
    first; if they differ, the folders have different photographs.
    """
    folders: dict[Path, dict[str, Path]] = defaultdict(dict)
    for file in files:
        folders[file.parent][file.stem.casefold()] = file
    pairs = []
    for a, b in combinations(folders.values(), 2):
        both = [(a[stem], b[stem]) for stem in a if stem in b]
        if any(_show_the_same(*pair, _FINE) for pair in _samples(both)):
            pairs += both
        elif not both and len(a) == len(b):
            ordered = list(zip(a.values(), b.values(), strict=True))
            if all(_show_the_same(*pair, _FINE) for pair in _samples(ordered)):
                pairs += ordered
    return pairs


def _samples(items: Sequence[tuple[Path, Path]]) -> Sequence[tuple[Path, Path]]:
    """Return the first, the middle and the last item."""
    step = max(1, (len(items) - 1) // (_SAMPLES - 1)) if items else 1
    return items[::step][:_SAMPLES]


def _show_the_same(a: Path, b: Path, side: int = _COARSE) -> bool:
    """Return whether two files show one photograph, by thumbnails [side, side]."""
    twins = a.parent == b.parent and _as_shot(a) == _as_shot(b)
    if twins and any(_is_heic(file) and size(file) == (0, 0) for file in (a, b)):
        return True  # a phone writes both formats, and the package that reads HEIC is missing here
    aspects = [width / height if height else 0.0 for width, height in (size(a), size(b))]
    if min(aspects) == 0 or abs(aspects[0] / aspects[1] - 1) > _ASPECT_TOLERANCE:
        return False
    first, second = _thumbnail(a), _thumbnail(b)
    if first is None or second is None:
        return False
    if twins:
        least = _LEAST_ALIKE_TWINS
    else:
        least = _LEAST_ALIKE_SIZE if size(a) == size(b) else _LEAST_ALIKE
    return _correlation(_averaged(first, side), _averaged(second, side)) > least


def _as_shot(file: Path) -> str:
    """Return a file's name without suffix and edit mark, which files of one photograph share."""
    return _EDITED.sub("", file.stem.casefold())


def _averaged(thumbnail: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Average a thumbnail to [side, side]; `side` must divide its size."""
    block = len(thumbnail) // side
    blocks = thumbnail.reshape(side, block, side, block)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float64)


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the correlation of two pictures; 0 if one is flat."""
    if a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def _is_heic(file: Path) -> bool:
    return file.suffix.lower() in images.HEIC
