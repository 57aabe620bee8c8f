"""Unpacks a folder of an untrusted zip archive."""

from __future__ import annotations

import re
import secrets
import shutil
import stat
import zipfile
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio.confined import ConfinedPath, confined
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from pathlib import Path

#: Limits for one folder: unpacked bytes, far more than the largest LLFF scene has, and files.
_MAX_BYTES = 8 << 30
_MAX_FILES = 10_000
#: The largest ratio of unpacked to packed bytes of a folder; photographs hardly shrink.
_MAX_RATIO = 100
_CHUNK = 1 << 20
#: Names that are devices on some systems, whatever their suffix.
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_ENCRYPTED = 0x1


class UnpackError(XrgsError):
    """An archive can't be unpacked, or should not be; the message names it."""


def unpack(archive: Path, folder: str, target: Path) -> None:
    """Write a folder of an archive as `target`: all of it, or nothing.

    Args:
        archive: A zip file.
        folder: The path of a folder in it, with `/`.
        target: The folder to make: it must not exist, or be empty. Its parent is made.

    Raises:
        UnpackError: The archive is damaged; the folder is not in it; a name in the archive leads
            out of it, or is a link; the folder is larger than photographs are; or the disk can't
            take it.
    """
    try:
        with confined(archive).open() as stream, zipfile.ZipFile(stream) as opened:
            members = _members(opened, archive, folder)
            home = ConfinedPath(target.parent)
            home.make_root()
            # In the same file system as the target, so that a rename moves it.
            made = home / f".unpacking-{secrets.token_hex(4)}"
            try:
                for member in progress(members, f"unpacking {folder}", "file"):
                    _write(opened, member, made / member.filename.removeprefix(f"{folder}/"))
                made.sync_tree()
                made.rename(home / target.name)
            finally:
                made.remove()
            (home / target.name).sync_name()
    except UnpackError:
        raise
    except OSError as error:
        raise UnpackError(f"{archive}: can't be unpacked into {target} ({error})") from error
    except Exception as error:  # zipfile raises nearly anything on a damaged archive
        why = for_line(str(error))
        raise UnpackError(f"{archive}: not a complete zip archive ({why}); delete it") from error


def _members(opened: zipfile.ZipFile, archive: Path, folder: str) -> list[zipfile.ZipInfo]:
    """List the files in `folder`; one bad name anywhere in the archive refuses all of it."""
    for member in opened.infolist():
        if why := _why_refused(member):
            raise UnpackError(f"{archive}: {member.filename!r} in it {why}; nothing was unpacked")
    inside = f"{folder}/"
    members = [m for m in opened.infolist() if m.filename.startswith(inside) and not m.is_dir()]
    if not members:
        raise UnpackError(f"{archive}: there is no folder {folder} in it")
    names = {member.filename.casefold() for member in members}
    size, packed = sum(m.file_size for m in members), sum(m.compress_size for m in members)
    excess = {
        "holds two files of one name": len(names) < len(members),
        f"holds {len(members)} files": len(members) > _MAX_FILES,
        f"unpacks to {size} bytes": size > _MAX_BYTES,
        f"unpacks {packed} bytes to {size}": size > _MAX_RATIO * max(packed, 1),
    }
    if wrong := [text for text, holds in excess.items() if holds]:
        raise UnpackError(f"{archive}: {folder} {wrong[0]}: too much for a folder of photographs")
    return members


def _why_refused(member: zipfile.ZipInfo) -> str:
    """Say why a member must not be unpacked; empty where it may be."""
    name, mode = member.filename, member.external_attr >> 16
    parts = name.removesuffix("/").split("/")
    if name.startswith("/") or "\\" in name or ":" in name or "\0" in member.orig_filename:
        return "is not a relative path"
    if any(part in ("", ".", "..") for part in parts):
        return "leads out of its folder"
    if any(_DEVICES.fullmatch(part) or not part.isprintable() for part in parts):
        return "is not a valid file name"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a link or a device"
    return "is encrypted" if member.flag_bits & _ENCRYPTED else ""


def _write(opened: zipfile.ZipFile, member: zipfile.ZipInfo, file: ConfinedPath) -> None:
    """Unpack one file; zipfile reads no more than its header declares, and checks its CRC."""
    file.parent.make_folder()
    with opened.open(member) as source, file.create() as stream:
        shutil.copyfileobj(source, stream, _CHUNK)
