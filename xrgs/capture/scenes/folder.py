"""Lists the photographs in a folder: any folder of images, or a scene in LLFF's layout.

LLFF's layout ([mildenhall2019], "Local light field fusion") has the photographs in `images/`,
copies that are smaller by a factor N in `images_N/`, and poses in `poses_bounds.npy`, which are not
read. The photographs of all folders below one are listed where its path ends with `/**`.

Images and videos that are not listed are counted in notes, which say how to get them.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from xrgs.capture import images
from xrgs.capture.scenes.copies import SIZES, one_of_each_size, size, without_copies
from xrgs.capture.scenes.scene import ALL_BELOW, Scene, files_digest, label, remembered
from xrgs.errors import UnreadableError, XrgsError
from xrgs.runtime.text import listed
from xrgs.safeio.files import is_name
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import counted, for_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from xrgs.config import SceneConf

#: Those of images that are not read: raw files, and formats that no camera of today writes.
_OTHER_IMAGES = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".dng", ".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2"}
    | {".srw", ".x3f", ".avif", ".exr", ".gif", ".hdr", ".insp", ".jfif", ".jp2", ".jxl", ".psd"}
)
#: Suffixes of videos.
VIDEOS = frozenset({".3gp", ".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mts", ".webm"})
#: What programs make around photographs, by the entries of the folder that tell it.
_MADE = {
    "a store of xrgs": ("cells", "variants"),
    "a variant of xrgs": ("variant.json",),
    "a cell of xrgs": ("config.json", "identity.json"),
    "a report of xrgs": ("cells.csv", "table.md"),
    "an export of xrgs": ("split.json", "transform.json"),
}
#: What else is not taken with `/**`, in words for people.
_MASKS, _LINKS, _SYSTEM = "masks", "links to folders are not followed", "folders of the system"
_UNDISTORTED = "copies that COLMAP undistorted"
#: Folders of thumbnails, of what was deleted, and of other files that systems keep beside files.
_OF_SYSTEM = frozenset(
    {"#recycle", "$recycle.bin", "@eadir", "__macosx", "lost+found", "system volume information"}
)
_MASK = r"masks?|segmentations?|seg|segments|mattes?|silhouettes?"
#: The names of folders of masks, and of other images that programs make of photographs.
_OF_MASKS = re.compile(rf"(?:.*[\W_])?(?:{_MASK})(?:[\W_\d].*)?", re.IGNORECASE)
_OF_OTHERS = re.compile(
    r"(?:.*[\W_])?(?:depths?|depth_?maps?|disparity|normals|normal_?maps?|thumbs?|thumbnails?)"
    r"(?:[\W_\d].*)?",
    re.IGNORECASE,
)
#: What a name has before or after the name of the photograph that an image was made of.
_ADDED = rf"(?:{_MASK}|depth|disparity|normals?|thumb|thumbnail)"
_ADDED_BEFORE, _ADDED_AFTER = re.compile(rf"^{_ADDED}[\W_]?"), re.compile(rf"[\W_]?{_ADDED}$")
#: The deepest nesting of folders that is searched, and what is said of those below it.
_MAX_DEPTH = 8
_DEEP = f"nested more than {_MAX_DEPTH} folders deep; move them up"
#: A picture that is longer for its width than this, and so many times longer than the others, is
#: called a panorama. It would set the size of all others, and SfM can't place it. Our choice.
_PANORAMA, _TIMES = 2.2, 1.6
#: The least share of the values of a mask of three channels that is 0 or 1.
_SHARE_OF_ENDS = 0.95


@dataclass(frozen=True)
class Listing:
    """The photographs of a folder."""

    files: dict[str, Path]
    """At least two files by the names of their views, sorted by name."""
    notes: tuple[str, ...]
    """Sentences on what was left out, and on which of several copies was taken."""


class FolderScene:
    """The photographs in a folder."""

    def names(self, conf: SceneConf, long_side: int) -> list[str]:
        """Return the names of the photographs, see `list_photographs`."""
        return list(list_photographs(conf.path, long_side, conf.masks))

    def digest(self, conf: SceneConf, long_side: int) -> str:
        """Hash the names and bytes of the photographs."""
        return files_digest(list_photographs(conf.path, long_side, conf.masks))

    def resolve(self, conf: SceneConf, long_side: int, home: Path) -> Scene:
        """List the photographs."""
        found = look(conf.path, long_side, conf.masks)
        return Scene(label(conf), home.name, found.files, notes=found.notes)


def list_photographs(path: str | None, long_side: int, masks: str | None = None) -> dict[str, Path]:
    """List the image files of a scene's folder; see `look`."""
    return look(path, long_side, masks).files


def look(path: str | None, long_side: int, masks: str | None = None) -> Listing:
    """List the image files of a scene's folder, and say what is not among them.

    Args:
        path: `scene.path`, the folder; with `/**` at its end, all folders below it too.
        long_side: `variant.long_side`, px. Of an LLFF scene the smallest copies whose longer side
            has at least so many px are taken; the largest where none has, or where this is 0.
        masks: `scene.masks`, a folder that is not looked into; None where there is none.

    Returns:
        The files and the notes. The name of a view is the name of the file without its suffix; with
        `/**` the folders on the way come before it, joined by `_`.

    Raises:
        UnreadableError: The folder or a file in it can't be read now.
        XrgsError: The folder is missing, has fewer than two images that can be used or two of one
            name, or images are HEIC and the package that reads it is not installed.
    """
    if not path:
        raise XrgsError("scene.path is empty: give the folder of photographs, scene.path=...")
    folder, nested = user_path(path.removesuffix(ALL_BELOW)), path.endswith(ALL_BELOW)
    try:
        if not folder.is_dir():
            why = "no such folder"
            if folder.is_file():
                why = "not a folder; for the frames of a video: scene=video scene.path=..."
            raise XrgsError(f"scene.path={folder}: {why}")
        known = None if masks is None else user_path(masks).resolve()
        found = (_all_below if nested else _inside)(folder, long_side, known)
        listed_files = [file for inside in found.folders.values() for file in inside]
        named, unnamed = _named(listed_files, folder, nested=nested)
        photographs, made = _photographs([*named], folder)
        single, copies = without_copies(photographs, folder, found.other_sizes)
        files, shapes = _without_panoramas(single, folder)
        not_read = _not_read({folder, *found.folders}, files)
        grey = _grey(files, folder)
        said = (*found.notes, *unnamed, *made, *copies, *shapes, *grey, *not_read)
        notes = tuple(map(for_line, said))  # names in them may be no text, which no file takes
    except OSError as error:
        raise UnreadableError(f"{error.filename}: {error.strerror}; try again") from error
    if len(files) < 2:
        count = f"only {files[0].name}" if files else "no image"
        suffixes = " ".join(sorted(images.SUFFIXES))
        why = f"{count} in it; two or more are needed ({suffixes})"
        raise XrgsError("; ".join([f"scene.path={folder}: {why}", *notes]))
    _check_heic(files)
    return Listing(_by_name([(named[file], file) for file in files]), notes)


#: Images by their folder.
_Tree = Mapping[Path, list[Path]]


@dataclass(frozen=True)
class _Found:
    """The images of folders, before copies of other names are left out."""

    folders: _Tree
    notes: list[str]
    other_sizes: list[Path]
    """Images in folders of an LLFF scene of which another size is taken."""


def _inside(folder: Path, long_side: int, masks: Path | None) -> _Found:
    """List the photographs in a folder itself, or one of the sizes of an LLFF scene."""
    inside = filter(_is_size, sorted(folder.iterdir()))
    sizes = {one: files for one in inside if (files := _images_in(one))}
    taken, notes = one_of_each_size([*sizes.values()], long_side)
    by_name = {files[0].parent.name: list(files) for files in taken}
    # Without a folder images/, folders that are not sizes of each other are no LLFF scene.
    choice = by_name.get("images") or (next(iter(by_name.values())) if len(taken) == 1 else None)
    tree = {choice[0].parent: choice} if choice else {folder: _images_in(folder)}
    others = _in_other_folders(folder, {**sizes, **tree} if len(taken) == 1 else tree, masks)
    return _Found(tree, [*(notes if choice else ()), *others], [])


def _all_below(folder: Path, long_side: int, masks: Path | None) -> _Found:
    """List the photographs in a folder and all below it, of LLFF scenes those of one size."""
    passed: dict[str, list[Path]] = defaultdict(list)
    tree = {inside: _images_in(inside) for inside in _folders(folder, passed, masks)}
    if not any(tree.values()):  # the undistorted ones are all there is
        tree |= {inside: _images_in(inside) for inside in passed.pop(_UNDISTORTED, ())}
    dropped, notes = _other_sizes(tree, long_side)
    root = folder.resolve()
    for what in sorted(passed.keys() - {_MASKS}):
        own = [inside for inside in passed[what] if not _is_link_into(inside, root)]
        notes += _left_out({inside: _count_anywhere(inside) for inside in own}, folder, what)
    return _Found(
        {inside: files for inside, files in tree.items() if inside not in dropped},
        notes + _masks_left_out(passed, folder),
        [file for inside in dropped for file in tree[inside]],
    )


def _other_sizes(tree: _Tree, long_side: int) -> tuple[list[Path], list[str]]:
    """Return the folders of the LLFF scenes among folders of which another size is taken."""
    groups = defaultdict(list)
    for inside, files in tree.items():
        if files and SIZES.fullmatch(inside.name):
            groups[inside.parent].append(files)
    dropped, notes = [], []
    for group in groups.values():
        taken, more = one_of_each_size(group, long_side)
        dropped += [files[0].parent for files in group if files not in taken]
        notes += more
    return dropped, notes


def _folders(
    folder: Path, passed: dict[str, list[Path]], masks: Path | None, depth: int = 0
) -> Iterator[Path]:
    """Yield a folder and all below it that may hold photographs; add the others to `passed`.

    Hidden folders and the folder of `scene.masks` are passed over in silence.
    """
    yield folder
    for inside in sorted(folder.iterdir()):
        if inside.name.startswith(".") or not inside.is_dir() or inside.resolve() == masks:
            continue
        if inside.is_symlink():
            passed[_LINKS].append(inside)
        elif what := _made_by_programs(inside):
            passed[what].append(inside)
        elif depth == _MAX_DEPTH:
            passed[_DEEP].append(inside)
        else:
            yield from _folders(inside, passed, masks, depth + 1)


def _made_by_programs(folder: Path) -> str:
    """Say what a folder holds in place of photographs; empty where it may hold photographs."""
    if folder.name.casefold() in _OF_SYSTEM:
        return _SYSTEM
    # `image_undistorter` makes stereo/; 3DGS's script keeps the photographs in input/.
    beside = {name for name in ("input", "sparse", "stereo") if (folder.parent / name).is_dir()}
    if SIZES.fullmatch(folder.name) and "sparse" in beside and len(beside) > 1:
        return _UNDISTORTED
    if _OF_MASKS.fullmatch(folder.name):
        return _MASKS
    if _OF_OTHERS.fullmatch(folder.name):
        return "made of photographs, by the folder's name"
    found = (what for what, names in _MADE.items() if all((folder / n).exists() for n in names))
    return next(found, "")


def _is_link_into(inside: Path, root: Path) -> bool:
    return inside.is_symlink() and inside.resolve().is_relative_to(root)


def _count_anywhere(folder: Path) -> int:
    """Count the images in a folder and below it, as far as they can be listed now."""
    count, waiting = 0, [str(folder)]
    while waiting:  # `os.walk` calls itself for each folder, and they may be nested a thousand deep
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                else:
                    count += Path(entry.name).suffix.lower() in images.SUFFIXES
    return count


def _in_other_folders(folder: Path, taken: _Tree, masks: Path | None) -> list[str]:
    """Say which images in and below a folder are not taken, and how to get them."""
    passed: dict[str, list[Path]] = defaultdict(list)
    try:
        below = [inside for inside in _folders(folder, passed, masks) if inside not in taken]
        images_in = {inside: files for inside in below if (files := _images_in(inside))}
        stems = {file.stem.casefold() for files in taken.values() for file in files}
        for inside, files in images_in.items():
            if files[0].stem.casefold() in stems and _is_mask(files[0]):
                passed[_MASKS].append(inside)
    except OSError as error:
        return [f"the folders below can't be searched for more images ({error})"]
    counts = {f: len(files) for f, files in images_in.items() if f not in passed[_MASKS]}
    all_below = f"scene.path={folder}{ALL_BELOW} takes the images of all folders"
    deep = {inside: _count_anywhere(inside) for inside in passed.get(_DEEP, ())}
    return [
        *_left_out(counts, folder, all_below),
        *_left_out(deep, folder, _DEEP),
        *_masks_left_out(passed, folder),
    ]


def _masks_left_out(passed: Mapping[str, Sequence[Path]], folder: Path) -> list[str]:
    counts = {inside: _count_anywhere(inside) for inside in passed.get(_MASKS, ())}
    use = f"{_MASKS}; scene.masks={next(iter(counts), folder)} uses them"
    return _left_out(counts, folder, use)


def _left_out(counts: Mapping[Path, int], folder: Path, why: str) -> list[str]:
    """Say how many images are left out in which folders; nothing where there are none."""
    where = [
        f"{count} in {inside.relative_to(folder) if inside != folder else 'it'}"
        for inside, count in sorted(counts.items())
        if count
    ]
    return [f"images left out: {listed(where)} ({why})"] if where else []


def _photographs(files: Sequence[Path], folder: Path) -> tuple[list[Path], list[str]]:
    """Leave out images that were made of photographs, and say so; images of xrgs alone are kept."""
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
def _is_mask(file: Path) -> bool:
    """Return whether an image has one channel, or hardly another value than 0 and the largest."""
    try:
        pixels = None if not images.has_colour(file) else images.decode(file).pixels
    except images.ImageError:
        return False
    return pixels is None or bool(np.mean((pixels == 0) | (pixels == 1)) > _SHARE_OF_ENDS)


def _made_of_others(files: Sequence[Path]) -> set[Path]:
    """Find masks, depth maps and thumbnails by the names of their photographs.

    These are `a.jpg.png` and `a_mask.png` where there is an `a.jpg`, and an image of one channel
    or of two values where another one of the same name is a photograph. The first image of a folder
    stands for all.
    """
    names = {file.name.casefold() for file in files}
    named = defaultdict(list)
    for file in files:
        named[file.stem.casefold()].append(file)
    made = set()
    for stem, group in named.items():
        plain = {_ADDED_BEFORE.sub("", stem), _ADDED_AFTER.sub("", stem)} - {stem}
        if stem in names or plain & named.keys():
            made |= {*group}
    by_folder = defaultdict(list)
    for file in files:
        if len(named[file.stem.casefold()]) > 1 and file not in made:
            by_folder[file.parent, file.suffix.lower()].append(file)
    masks = {file for group in by_folder.values() if _is_mask(group[0]) for file in group}
    return made if masks == {*chain(*by_folder.values())} else made | masks


def _not_read(folders: Iterable[Path], taken: Sequence[Path]) -> list[str]:
    """Say which images and videos in folders can't be taken as they are, and what to do."""
    shown = {file.with_suffix("") for file in taken}
    videos, others, irregular = (
        [file for folder in sorted(folders) for file in _with_suffix(folder, suffixes)]
        for suffixes in (VIDEOS, _OTHER_IMAGES, images.SUFFIXES)
    )
    lines = []
    if alone := [file for file in videos if file.with_suffix("") not in shown]:
        how = f"scene=video scene.path={alone[0]} takes frames of one"
        lines.append(f"videos left out: {len(alone)} ({how})")
    if alone := [file for file in others if file.with_suffix("") not in shown]:
        lines.append(
            f"images left out: {len(alone)} of a format that is not read "
            f"({listed([file.name for file in alone])}); convert them to PNG or JPEG"
        )
    if beside := [file for file in (*videos, *others) if file.with_suffix("") in shown]:
        names = listed([file.name for file in beside])
        lines.append(f"not read, beside photographs of the same names: {names}")
    if pipes := [file for file in irregular if not file.is_file() and not file.is_dir()]:
        names = listed([file.name for file in pipes])
        lines.append(f"left out, neither regular files nor links to one (pipes?): {names}")
    return lines


def _without_panoramas(files: Sequence[Path], folder: Path) -> tuple[list[Path], list[str]]:
    """Leave out panoramas, which no pinhole camera took, and name other pictures of their shape."""
    aspects = {file: max(size(file)) / min(size(file)) for file in files if min(size(file))}
    usual = median(aspects.values()) if aspects else 1.0
    longer = {f for f, a in aspects.items() if a > max(1.1 * usual, min(_PANORAMA, _TIMES * usual))}
    panoramas = {f for f in longer if aspects[f] > max(_PANORAMA, _TIMES * usual)}
    notes = [
        f"{why}: {listed([str(file.relative_to(folder)) for file in sorted(those)])}"
        for why, those in (
            ("left out as panoramas, by their shape", panoramas),
            ("longer for their width than others (screenshots, crops?)", longer - panoramas),
        )
        if those
    ]
    return [file for file in files if file not in panoramas], notes


def _grey(files: Sequence[Path], folder: Path) -> list[str]:
    """Say which photographs are grey, where others have colour."""
    grey = [file for file in files if _is_grey(file)]
    if not grey or len(grey) == len(files):
        return []
    names = listed([str(file.relative_to(folder)) for file in sorted(grey)])
    return [f"grey, where others have colour: {names}"]


@remembered
def _is_grey(file: Path) -> bool:
    """Return whether a JPEG is grey; one channel of other formats may be a palette's colours."""
    try:
        return file.suffix.lower() in {".jpg", ".jpeg"} and not images.has_colour(file)
    except images.ImageError:
        return False


def _named(
    files: Sequence[Path], folder: Path, *, nested: bool
) -> tuple[dict[Path, str], list[str]]:
    """Name the views of files; leave out files whose names can't be used, and say so."""
    names = {
        file: "_".join(file.relative_to(folder if nested else file.parent).with_suffix("").parts)
        for file in files
    }
    unusable = [file for file, name in names.items() if not is_name(name)]
    if not unusable:
        return names, []
    # As Python writes them: a line break, or bytes that are no text, can't be shown.
    shown = listed([repr(str(file.relative_to(folder))) for file in unusable])
    why = "a backslash, a control character or bytes that are not valid Unicode, or is too long"
    notes = [f"{counted(len(unusable), 'image')} left out, whose name has {why}; rename: {shown}"]
    return {file: name for file, name in names.items() if file not in unusable}, notes


def _by_name(named: Sequence[tuple[str, Path]]) -> dict[str, Path]:
    """Return files by name, sorted; refuse two names that are one."""
    seen: dict[str, Path] = {}
    for name, file in named:
        # On some file systems A and a, or an accent as one or two characters, are one name.
        key = unicodedata.normalize("NFC", name).casefold()
        if key in seen:
            raise XrgsError(
                f"{seen[key]} and {file}: two images of one name, {name}; rename one, or move it"
                " out of the folder"
            )
        seen[key] = file
    return dict(sorted(named))


def _check_heic(files: Sequence[Path]) -> None:
    heic = [file for file in files if file.suffix.lower() in images.HEIC]
    if heic and find_spec("pillow_heif") is None:
        raise XrgsError(
            f"{heic[0]}: {len(heic)} of {len(files)} photographs are HEIC, which needs "
            "pillow-heif: pip install 'xrgs[heic]'"
        )


def _is_size(folder: Path) -> bool:
    return SIZES.fullmatch(folder.name) is not None and folder.is_dir()


def _images_in(folder: Path) -> list[Path]:
    """List the regular files that are photographs by their suffix, and the links to such files."""
    return [file for file in _with_suffix(folder, images.SUFFIXES) if file.is_file()]


def _with_suffix(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    """List the files of these suffixes in a folder, sorted, without hidden files."""
    files = sorted(folder.iterdir(), key=lambda file: file.name)
    return [f for f in files if f.suffix.lower() in suffixes and not f.name.startswith(".")]
