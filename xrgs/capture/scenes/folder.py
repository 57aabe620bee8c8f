"""Lists the photographs in a folder: any folder of images, or a scene in LLFF's layout.

LLFF's layout ([mildenhall2019], "Local light field fusion") has the photographs in `images/`,
copies that are smaller by a factor N in `images_N/`, and poses in `poses_bounds.npy`, which are not
read. The photographs of all folders below one are listed where its path ends with `/**`.

Images and videos that are not listed are counted in a warning, which says how to get them.
"""

from __future__ import annotations

import logging
import re
import unicodedata
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture import images
from xrgs.capture.scenes.scene import ALL_BELOW, Scene, files_digest, label
from xrgs.errors import UnreadableError, XrgsError
from xrgs.safeio.files import is_name
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from xrgs.config import SceneConf

_log = logging.getLogger(__name__)

_HEIC = frozenset({".heic", ".heif"})
#: The suffixes of files that are read as photographs, in lower case.
SUFFIXES = _HEIC | {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}
#: Those of images that are not read: raw files, and formats that no camera of today writes.
_OTHER_IMAGES = frozenset(
    {".arw", ".avif", ".cr2", ".cr3", ".dng", ".exr", ".gif", ".hdr", ".jp2", ".jxl", ".nef"}
    | {".orf", ".pef", ".raf", ".rw2", ".srw"}
)
_VIDEOS = frozenset({".3gp", ".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mts", ".webm"})
_LLFF_FOLDER = re.compile(r"images(_\d+)?")
#: The deepest nesting of folders that is searched.
_MAX_DEPTH = 8


class FolderScene:
    """The photographs in a folder."""

    def names(self, conf: SceneConf, long_side: int) -> list[str]:
        """Return the names of the photographs, see `list_photographs`."""
        return list(list_photographs(conf.path, long_side))

    def digest(self, conf: SceneConf, long_side: int) -> str:
        """Hash the names and bytes of the photographs."""
        return files_digest(list_photographs(conf.path, long_side))

    def resolve(self, conf: SceneConf, long_side: int, home: Path) -> Scene:
        """List the photographs."""
        return Scene(label(conf), home.name, list_photographs(conf.path, long_side))


def list_photographs(path: str | None, long_side: int) -> dict[str, Path]:
    """List the image files of a scene's folder.

    Args:
        path: `scene.path`, the folder; with `/**` at its end, all folders below it too.
        long_side: `variant.long_side`, px. Of an LLFF scene the smallest copies whose longer side
            has at least so many px are taken; the largest where none has, or where this is 0.

    Returns:
        At least two files by the names of their views, sorted by name: the name of the file without
        its suffix. With `/**` the folders on the way come before it, joined by `_`.

    Raises:
        UnreadableError: The folder can't be read now.
        XrgsError: The folder is missing, has fewer than two images or two of one name, a name can't
            be used, or images are HEIC and the package that reads it is not installed.
    """
    if not path:
        raise XrgsError("scene.path is empty: give the folder of photographs, scene.path=...")
    folder = user_path(path.removesuffix(ALL_BELOW))
    try:
        if not folder.is_dir():
            why = "no such folder (scenes of llff/ and captures/ are looked for in data_root)"
            if folder.is_file():
                why = "not a folder; for the frames of a video: scene=video scene.path=..."
            raise XrgsError(f"scene.path={folder}: {why}")
        nested = path.endswith(ALL_BELOW)
        taken = _all_below(folder) if nested else _select(folder, long_side)
        left_out = [] if nested else _in_other_folders(folder, taken)
        looked_in = _folders(folder) if nested else {folder, *(file.parent for file in taken)}
        for parent in sorted(looked_in):
            left_out += _not_read(parent)
    except OSError as error:
        raise UnreadableError(f"{error.filename}: {error.strerror}; try again") from error
    if len(taken) < 2:
        count = f"only {taken[0].name}" if taken else "no image"
        suffixes = " ".join(sorted(SUFFIXES))
        why = f"{count} in it; two or more are needed ({suffixes})"
        raise XrgsError("; ".join([f"scene.path={folder}: {why}", *left_out]))
    for line in left_out:
        _log.warning("%s", for_line(f"{folder}: {line}"))
    _check_heic(taken)
    return _by_name([(_view_name(file, folder if nested else file.parent), file) for file in taken])


def _view_name(file: Path, folder: Path) -> str:
    """Return the name of the view of a photograph in or below a folder."""
    return "_".join(file.relative_to(folder).with_suffix("").parts)


def _by_name(named: Sequence[tuple[str, Path]]) -> dict[str, Path]:
    """Return files by name, sorted; refuse names that can't be used, and two that are one."""
    seen: dict[str, Path] = {}
    for name, file in named:
        if not is_name(name):
            raise XrgsError(
                f"{str(file)!r}: its name has a backslash, a control character or bytes that are "
                "not valid Unicode, or is too long; rename it"
            )
        # On some file systems A and a, or an accent as one or two characters, are one name.
        key = unicodedata.normalize("NFC", name).casefold()
        if key in seen:
            raise XrgsError(f"{seen[key]} and {file.name}: two images of one name; rename one")
        seen[key] = file
    return dict(sorted(named))


def _check_heic(files: Sequence[Path]) -> None:
    heic = [file for file in files if file.suffix.lower() in _HEIC]
    if heic and find_spec("pillow_heif") is None:
        raise XrgsError(
            f"{heic[0]}: {len(heic)} of {len(files)} photographs are HEIC, which needs "
            "pillow-heif: pip install 'xrgs[heic]'"
        )


def _is_llff_folder(folder: Path) -> bool:
    return folder.is_dir() and _LLFF_FOLDER.fullmatch(folder.name) is not None


def _images_in(folder: Path) -> tuple[Path, ...]:
    """List the regular files that are photographs by their suffix, and the links to such files."""
    return tuple(file for file in _with_suffix(folder, SUFFIXES) if file.is_file())


def _with_suffix(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    """List the files of these suffixes in a folder, sorted, without hidden files."""
    files = sorted(folder.iterdir(), key=lambda file: file.name)
    return [f for f in files if f.suffix.lower() in suffixes and not f.name.startswith(".")]


def _select(folder: Path, long_side: int) -> tuple[Path, ...]:
    """Select the photographs in a folder, or the copies of an LLFF scene."""
    copies = [_images_in(f) for f in sorted(folder.iterdir()) if _is_llff_folder(f)]
    return _select_copies([c for c in copies if c], long_side) or _images_in(folder)


def _all_below(folder: Path) -> tuple[Path, ...]:
    return tuple(file for inside in _folders(folder) for file in _images_in(inside))


def _folders(folder: Path, depth: int = 0) -> Iterator[Path]:
    """Yield a folder and all folders below it, without hidden folders and links."""
    if depth > _MAX_DEPTH:
        raise XrgsError(f"{folder}: folders are nested more than {_MAX_DEPTH} deep")
    yield folder
    for inside in sorted(folder.iterdir()):
        if inside.is_dir() and not inside.is_symlink() and not inside.name.startswith("."):
            yield from _folders(inside, depth + 1)


def _in_other_folders(folder: Path, taken: Sequence[Path]) -> list[str]:
    """Say which images in and below a folder are not taken, and how to get them.

    The copies of an LLFF scene show what is taken in other sizes, and are no loss.
    """
    try:
        others = set(_all_below(folder)) - set(taken)
    except (OSError, XrgsError) as error:
        return [f"the folders below can't be searched for more images ({error})"]
    inside = Counter(file.parent for file in others if not _is_llff_folder(file.parent))
    return [
        f"images left out: {count} in {parent.relative_to(folder) if parent != folder else 'it'}"
        f" (scene.path={folder}{ALL_BELOW} takes the images of all folders)"
        for parent, count in sorted(inside.items())
    ]


def _not_read(folder: Path) -> list[str]:
    """Say which images and videos in a folder can't be taken as they are, and what to do."""
    lines = []
    if videos := _with_suffix(folder, _VIDEOS):
        how = f"scene=video scene.path={videos[0]} takes frames of one"
        lines.append(f"videos left out: {len(videos)} ({how})")
    if images := _with_suffix(folder, _OTHER_IMAGES):
        names = ", ".join(file.name for file in images[:3])
        lines.append(
            f"images left out: {len(images)} of a format that is not read ({names}); convert them "
            "to PNG or JPEG"
        )
    others = [f for f in _with_suffix(folder, SUFFIXES) if not f.is_file() and not f.is_dir()]
    why = "not a regular file, nor a link to one (a pipe?); left out"
    return lines + [f"{file}: {why}" for file in others]


def _select_copies(copies: list[tuple[Path, ...]], long_side: int) -> tuple[Path, ...]:
    """Select the copies of an LLFF scene to read; empty where there are none."""
    sides = sorted(((_long_side(files), files) for files in copies), key=lambda c: c[0])
    if not sides:
        return ()
    sufficient = [files for side, files in sides if long_side and side >= long_side]
    return sufficient[0] if sufficient else sides[-1][1]


def _long_side(files: tuple[Path, ...]) -> int:
    """Find the longest side of photographs, px; unreadable ones are reported when they are read."""
    sides = [0]
    for file in files:
        try:
            sides.append(max(images.size(file)))
        except images.ImageError:
            continue
    return max(sides)
