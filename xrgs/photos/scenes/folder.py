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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from xrgs.config import SceneConf
from xrgs.errors import UnreadableError, XrgsError
from xrgs.photos import foreign, images
from xrgs.photos.masks import WORDS
from xrgs.photos.scenes.copies import SIZES, one_of_each_size, without_copies
from xrgs.photos.scenes.no_photographs import is_mask, without_made, without_panoramas
from xrgs.photos.scenes.scene import ALL_BELOW, Scene, files_digest, label, remembered
from xrgs.runtime.text import listed
from xrgs.safeio.files import is_name
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import counted, for_line

#: Suffixes of images that are not read: raw files, stereo pairs and pictures of two fisheye lenses
#: in one file, thumbnails, and formats that no camera of today writes.
_OTHER_IMAGES = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc"}
    | {".mef", ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl"}
    | {".sr2", ".srw", ".x3f", ".dds", ".exr", ".fits", ".gif", ".hdr", ".heics", ".ico", ".insp"}
    | {".jps", ".jxl", ".jxr", ".pcx", ".pfm", ".psb", ".psd", ".qoi", ".sgi", ".svg", ".thm"}
    | {".wdp", ".xcf"}
)
#: Suffixes of videos.
VIDEOS = frozenset(
    {".360", ".3gp", ".avi", ".flv", ".insv", ".lrv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4"}
    | {".mpeg", ".mpg", ".mts", ".ogv", ".webm", ".wmv"}
)
_ARCHIVES = frozenset({".7z", ".gz", ".rar", ".tar", ".tgz", ".xz", ".zip"})
#: Folders that programs make -> the entries by which they are recognised.
_MADE = {
    "a store of xrgs": ("cells", "variants"),
    "a variant of xrgs": ("variant.json",),
    "a cell of xrgs": ("config.json", "identity.json"),
    "a report of xrgs": ("cells.csv", "table.md"),
    "an export of xrgs": ("split.json", "transform.json"),
}
#: Further reasons why `/**` leaves folders out, in the words of the notes.
_MASKS, _LINKS, _SYSTEM = "masks", "links to folders are not followed", "folders of the system"
_UNDISTORTED = "copies that COLMAP undistorted"
#: Names of folders that operating systems make: thumbnails, bins and the like.
_OF_SYSTEM = frozenset(
    {"#recycle", "$recycle.bin", "@eadir", "__macosx", "lost+found", "system volume information"}
)
#: The names of folders of masks, and of other images that programs make of photographs.
_OF_MASKS = re.compile(rf"(?:.*[\W_])?(?:{WORDS})(?:[\W_\d].*)?", re.IGNORECASE)
_OF_OTHERS = re.compile(
    r"(?:.*[\W_])?(?:depths?|depth_?maps?|disparity|normals|normal_?maps?|thumbs?|thumbnails?)"
    r"(?:[\W_\d].*)?",
    re.IGNORECASE,
)
#: The deepest nesting of folders that is searched, and the note on deeper ones.
_MAX_DEPTH = 8
_DEEP = f"nested more than {_MAX_DEPTH} folders deep; move them up"


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
    """List the image files of a scene's folder, with notes on what was left out.

    The name of a view is the name of the file without its suffix; with `/**` the names of the
    folders between come before it, joined by `_`.

    Args:
        path: `scene.path`, the folder; with `/**` at its end, all folders below it too.
        long_side: `variant.long_side`, px. Of an LLFF scene the smallest copies whose longer side
            is at least this long are taken; the largest if none is, or if this is 0.
        masks: `scene.masks`, a folder that is skipped; None if there is none.

    Raises:
        UnreadableError: The folder or a file in it can't be read now.
        XrgsError: The folder is missing, has fewer than two usable images, or two of one name; or
            there are HEIC images, and the package that reads them is not installed.
    """
    if not path:
        raise XrgsError("scene.path is empty: give the folder of photographs, scene.path=...")
    folder, nested = user_path(path.removesuffix(ALL_BELOW)), path.endswith(ALL_BELOW)
    try:
        if not folder.is_dir():
            why = _not_a_folder(folder) if folder.is_file() else "no such folder"
            raise XrgsError(f"scene.path={folder}: {why}")
        known = None if masks is None else user_path(masks).resolve()
        found = (_all_below if nested else _inside)(folder, long_side, known)
        listed_files = [file for inside in found.folders.values() for file in inside]
        named, unnamed = _named(listed_files, folder, nested=nested)
        photographs, made = without_made([*named], folder)
        single, copies = without_copies(photographs, folder, found.other_sizes)
        files, shapes = without_panoramas(single, folder)
        not_read = _not_read({folder, *found.folders}, files)
        grey = _grey(files, folder)
        said = (*found.notes, *unnamed, *made, *copies, *shapes, *grey, *_rare(files), *not_read)
        notes = tuple(map(for_line, said))  # names in them may not be valid text
    except OSError as error:
        raise UnreadableError(f"{error.filename}: {error.strerror}; try again") from error
    if len(files) < 2:
        count = f"only {files[0].name}" if files else "no image"
        suffixes = " ".join(sorted(images.USUAL_SUFFIXES))
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
    """Images of an LLFF scene that are left out, since another size is taken."""


def _inside(folder: Path, long_side: int, masks: Path | None) -> _Found:
    """List the photographs in a folder itself, or one of the sizes of an LLFF scene."""
    inside = [one for one in sorted(folder.iterdir()) if SIZES.fullmatch(one.name) and one.is_dir()]
    sizes = {one: files for one in inside if (files := _images_in(one))}
    taken, notes = one_of_each_size([*sizes.values()], long_side)
    by_name = {files[0].parent.name: list(files) for files in taken}
    # Without a folder images/, folders that are not sizes of each other are no LLFF scene.
    choice = by_name.get("images") or (next(iter(by_name.values())) if len(taken) == 1 else None)
    tree = {choice[0].parent: choice} if choice else {folder: _images_in(folder)}
    others = _in_other_folders(folder, {**sizes, **tree} if len(taken) == 1 else tree, masks)
    return _Found(tree, [*(notes if choice else ()), *others], [])


def _all_below(folder: Path, long_side: int, masks: Path | None) -> _Found:
    """List the photographs in a folder and all below it; of an LLFF scene only one size."""
    passed: dict[str, list[Path]] = defaultdict(list)
    tree = {inside: _images_in(inside) for inside in _folders(folder, passed, masks)}
    if not any(tree.values()):  # there are only undistorted copies
        tree |= {inside: _images_in(inside) for inside in passed.pop(_UNDISTORTED, ())}
    dropped, notes = _other_sizes(tree, long_side)
    root = folder.resolve()
    for what in sorted(passed.keys() - {_MASKS}):
        own = [f for f in passed[what] if what != _LINKS or not f.resolve().is_relative_to(root)]
        notes += _left_out({inside: _count_anywhere(inside) for inside in own}, folder, what)
    return _Found(
        {inside: files for inside, files in tree.items() if inside not in dropped},
        notes + _masks_left_out(passed, folder),
        [file for inside in dropped for file in tree[inside]],
    )


def _other_sizes(tree: _Tree, long_side: int) -> tuple[list[Path], list[str]]:
    """Return the folders of LLFF scenes that are left out for another size, and notes."""
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
    """Yield a folder and all below it that may hold photographs.

    The others are added to `passed`, by the reason; hidden folders and `scene.masks` are not.
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
    """Say what a folder holds in place of photographs; empty if it may hold photographs."""
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
            if files[0].stem.casefold() in stems and is_mask(files[0]):
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
    """Return a note on how many images are left out in each folder; none if there are none."""
    where = [
        f"{count} in {inside.relative_to(folder) if inside != folder else 'it'}"
        for inside, count in sorted(counts.items())
        if count
    ]
    return [f"images left out: {listed(where)} ({why})"] if where else []


def _not_a_folder(file: Path) -> str:
    """Say what to do with a file that was given in place of a folder."""
    suffix = file.suffix.lower()
    if suffix in _ARCHIVES:
        return f"an archive ({suffix}), not a folder; unpack it, and give the folder"
    if suffix in VIDEOS:
        return "a video, not a folder; scene=video takes its frames"
    what = f"{kind}, " if (kind := foreign.kind(file)) else ""
    return f"{what}not a folder; give the folder that the photographs are in"


def _rare(files: Sequence[Path]) -> list[str]:
    """Note the photographs with unusual suffixes, which were recognised by their content."""
    rare = [file.name for file in files if file.suffix.lower() not in images.USUAL_SUFFIXES]
    return [f"taken as photographs by what is in the files: {listed(rare)}"] if rare else []


def _not_read(folders: Iterable[Path], taken: Sequence[Path]) -> list[str]:
    """Say which images and videos in folders can't be taken as they are, and what to do."""
    shown = {file.with_suffix("") for file in taken}
    videos, others, archives, irregular = (
        [file for folder in sorted(folders) for file in _with_suffix(folder, suffixes)]
        for suffixes in (VIDEOS, _OTHER_IMAGES, _ARCHIVES, images.SUFFIXES)
    )
    others += [f for folder in sorted(folders) for f in _of_no_suffix(folder) if _told(f) is None]
    lines = []
    if alone := [file for file in videos if file.with_suffix("") not in shown]:
        how = f"scene=video scene.path={alone[0]} takes frames of one"
        lines.append(f"videos left out: {len(alone)} ({how})")
    if alone := [file for file in others if file.with_suffix("") not in shown]:
        lines.append(
            f"images left out: {len(alone)} of a format that is not read "
            f"({listed([file.name for file in alone])}); convert them to PNG or JPEG"
        )
    if archives:
        names = listed([file.name for file in archives])
        lines.append(f"archives, which are not looked into; unpack them: {names}")
    if beside := [file for file in (*videos, *others) if file.with_suffix("") in shown]:
        names = listed([file.name for file in beside])
        lines.append(f"not read, beside photographs of the same names: {names}")
    if pipes := [file for file in irregular if not file.is_file() and not file.is_dir()]:
        names = listed([file.name for file in pipes])
        lines.append(f"left out, neither regular files nor links to one (pipes?): {names}")
    return lines


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
    """Return the view's name of each file, and a note on files whose names can't be used."""
    names = {
        file: "_".join(file.relative_to(folder if nested else file.parent).with_suffix("").parts)
        for file in files
    }
    unusable = [file for file, name in names.items() if not is_name(name)]
    if not unusable:
        return names, []
    # By `repr`, since line breaks and invalid bytes can't be shown.
    shown = listed([repr(str(file.relative_to(folder))) for file in unusable])
    why = "a backslash, a control character or bytes that are not valid Unicode, or is too long"
    notes = [f"{counted(len(unusable), 'image')} left out, whose name has {why}; rename: {shown}"]
    return {file: name for file, name in names.items() if file not in unusable}, notes


def _by_name(named: Sequence[tuple[str, Path]]) -> dict[str, Path]:
    """Return files by name, sorted; refuse two files with one name."""
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


def _images_in(folder: Path) -> list[Path]:
    """List the regular files that are photographs, and the links to such files, sorted.

    The suffix decides, or the first bytes of a file without a known suffix.
    """
    known = [file for file in _with_suffix(folder, images.SUFFIXES) if file.is_file()]
    return sorted(known + [file for file in _of_no_suffix(folder) if _told(file)])


def _of_no_suffix(folder: Path) -> list[Path]:
    """List the regular files without a suffix of an image, a video or an archive, sorted."""
    known = images.SUFFIXES | _OTHER_IMAGES | VIDEOS | _ARCHIVES
    return [
        file
        for file in sorted(folder.iterdir(), key=lambda file: file.name)
        if file.suffix.lower() not in known and not file.name.startswith(".") and file.is_file()
    ]


@remembered
def _told(file: Path) -> bool | None:
    """Return `images.is_photograph`; False if the file can't be read."""
    try:
        return images.is_photograph(file)
    except OSError:
        return False


def _with_suffix(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    """List the files of these suffixes in a folder, sorted, without hidden files."""
    files = sorted(folder.iterdir(), key=lambda file: file.name)
    return [f for f in files if f.suffix.lower() in suffixes and not f.name.startswith(".")]
