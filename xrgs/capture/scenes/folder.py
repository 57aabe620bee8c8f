"""Lists the photographs in a folder: any folder of images, or a scene in LLFF's layout.

LLFF's layout ([mildenhall2019], "Local light field fusion") has the photographs in `images/`,
copies that are smaller by a factor N in `images_N/`, and poses in `poses_bounds.npy`, which are not
read.
"""

from __future__ import annotations

import hashlib
import logging
import re
import unicodedata
from pathlib import Path

from xrgs.capture import images
from xrgs.errors import UnreadableError, XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio import untrusted
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.paths import user_path
from xrgs.safeio.words import for_line

_log = logging.getLogger(__name__)

#: The suffixes of files that are read as photographs, in lower case.
SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
_LLFF_FOLDER = re.compile(r"images(_\d+)?")


def list_photographs(path: str | None, long_side: int) -> tuple[Path, ...]:
    """List the image files of a scene's folder.

    Args:
        path: `scene.path`, the folder.
        long_side: `variant.long_side`, px. Of an LLFF scene the smallest copies whose longer side
            has at least so many px are taken; the largest where none has, or where this is 0.

    Returns:
        At least two files, sorted by name.

    Raises:
        UnreadableError: The folder can't be read now.
        XrgsError: There is no such folder, it holds fewer than two images or two of one name, or a
            name can't be used.
    """
    if not path:
        raise XrgsError("scene.path is empty: give the folder of photographs, scene.path=...")
    folder = user_path(path)
    try:
        if not folder.is_dir():
            why = "no such folder (scenes of llff/ and captures/ are looked for in data_root)"
            raise XrgsError(f"scene.path={folder}: {why}")
        copies = [_images_in(f) for f in sorted(folder.iterdir()) if _is_llff_folder(f)]
        files = _select_copies([c for c in copies if c], long_side) or _images_in(folder)
    except OSError as error:
        raise UnreadableError(f"{error.filename}: {error.strerror}; try again") from error
    if len(files) < 2:
        count = f"only {files[0].name}" if files else "no image"
        suffixes = " ".join(sorted(SUFFIXES))
        raise XrgsError(f"scene.path={folder}: {count} in it; two or more are needed ({suffixes})")
    seen: dict[str, Path] = {}
    for file in files:
        if not untrusted.is_name(file.stem):
            raise XrgsError(
                f"{str(file)!r}: its name has a backslash, a control character or bytes that are "
                "not valid Unicode; rename it"
            )
        # On some file systems A and a, or an accent as one or two characters, are one name.
        name = unicodedata.normalize("NFC", file.stem).casefold()
        if name in seen:
            raise XrgsError(f"{seen[name]} and {file.name}: two images of one name; rename one")
        seen[name] = file
    return files


def files_digest(files: tuple[Path, ...]) -> str:
    """Hash the names and bytes of files.

    Args:
        files: The files; the hash depends on their order, and not on their folder.

    Returns:
        All 64 hexadecimal digits of a SHA-256.

    Raises:
        UnreadableError: A file can't be read now. It is not left out: the hash would be another one
            whenever a disk or a server fails.
    """
    sha256 = hashlib.sha256()
    for file in progress(files, "hashing photographs", "file"):
        try:
            content = file_digest(file)
        except OSError as error:
            why = f"{error.strerror}; try again, or move it out of the folder"
            raise UnreadableError(f"{file}: {why}") from error
        sha256.update(f"{file.name}\0{content}\n".encode())
    return sha256.hexdigest()


def _is_llff_folder(folder: Path) -> bool:
    return folder.is_dir() and _LLFF_FOLDER.fullmatch(folder.name) is not None


def _images_in(folder: Path) -> tuple[Path, ...]:
    """List the regular files that are photographs by their suffix, and the links to such files."""
    files = sorted(folder.iterdir(), key=lambda file: file.name)
    named = [f for f in files if f.suffix.lower() in SUFFIXES and not f.name.startswith(".")]
    for file in named:
        if not file.is_file() and not file.is_dir():
            why = "not a regular file, nor a link to one (a pipe, a device?)"
            _log.warning("%s: %s; left out", for_line(str(file)), why)
    return tuple(file for file in named if file.is_file())


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
