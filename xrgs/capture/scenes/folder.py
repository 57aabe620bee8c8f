"""Photographs in a folder: any folder of images, or a scene laid out as LLFF publishes them."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from pathlib import Path

from xrgs.capture import images
from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import path_of

SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
_LLFF_FOLDER = re.compile(r"images(_\d+)?")


def photographs(path: str | None, long_side: int) -> tuple[Path, ...]:
    """The image files of `scene.path`, sorted by name.

    In an LLFF scene (images/, images_4/, ...) the smallest copies whose longer side is at least
    `long_side` px are taken, the largest where none is or where 0 asks for full size.
    `poses_bounds.npy` is never read.

    Raises:
        XrgsError: no such folder, fewer than two images, or two of one name.
    """
    if not path:
        raise XrgsError("scene.path is empty: give the folder of photographs, scene.path=...")
    folder = path_of(path)
    if not folder.is_dir():
        raise XrgsError(f"scene.path={folder}: no such folder (scene=llff/... looks in data_root)")
    copies = [_images_in(f) for f in sorted(folder.iterdir()) if _is_llff(f)]
    files = _smallest([c for c in copies if c], long_side) or _images_in(folder)
    if len(files) < 2:
        count = f"only {files[0].name}" if files else "no image"
        wanted = " ".join(sorted(SUFFIXES))
        raise XrgsError(f"scene.path={folder}: {count} in it; two or more are needed ({wanted})")
    seen: dict[str, Path] = {}
    for file in files:
        if not untrusted.is_name(file.stem):
            raise XrgsError(
                f"{str(file)!r}: a name with a backslash, a control character or bytes that are "
                "no Unicode; rename it"
            )
        # A store may lie where A and a, or an accent as one character or two, are one name.
        name = unicodedata.normalize("NFC", file.stem).casefold()
        if name in seen:
            raise XrgsError(f"{seen[name]} and {file.name}: two images of one name; rename one")
        seen[name] = file
    return files


def digest(files: tuple[Path, ...]) -> str:
    """Hash of the files' names and bytes, hex."""
    total = hashlib.sha256()
    for file in progress(files, "hashing photographs", "file"):
        with file.open("rb") as stream:
            content = hashlib.file_digest(stream, "sha256").hexdigest()
        total.update(f"{file.name}\0{content}\n".encode())
    return total.hexdigest()


def _is_llff(folder: Path) -> bool:
    return folder.is_dir() and _LLFF_FOLDER.fullmatch(folder.name) is not None


def _images_in(folder: Path) -> tuple[Path, ...]:
    found = (f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and f.is_file())
    return tuple(sorted((f for f in found if not f.name.startswith(".")), key=lambda f: f.name))


def _smallest(copies: list[tuple[Path, ...]], long_side: int) -> tuple[Path, ...]:
    """The copies of an LLFF scene to read; empty where there are none."""
    sides = sorted(((_side(files), files) for files in copies), key=lambda c: c[0])
    if not sides:
        return ()
    enough = [files for side, files in sides if long_side and side >= long_side]
    return enough[0] if enough else sides[-1][1]


def _side(files: tuple[Path, ...]) -> int:
    """Longest side of the photographs of a folder; what can't be read is left to the reader."""
    sides = [0]
    for file in files:
        try:
            sides.append(max(images.size(file)))
        except images.ImageError:
            continue
    return max(sides)
