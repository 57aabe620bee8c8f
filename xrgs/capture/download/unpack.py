"""Folders out of a zip archive that somebody else made: nothing in it is trusted."""

from __future__ import annotations

import re
import shutil
import stat
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress

#: Of one folder, unpacked. The largest LLFF scene is a fraction of it.
_MOST_BYTES = 8 << 30
_MOST_FILES = 10_000
#: Bytes unpacked for one packed, over a folder: photographs hardly shrink.
_MOST_RATIO = 100
_CHUNK = 1 << 20
#: Names that are devices on some systems, whatever their ending.
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_ENCRYPTED = 0x1


class UnpackError(XrgsError):
    """An archive that can't be unpacked, or should not be; the message names it."""


def unpack(archive: Path, folder: str, target: Path) -> None:
    """Write a folder of the archive as `target`: all of it, or nothing.

    Args:
        archive: A zip file.
        folder: Path in it, with `/`.
        target: Must not exist, or be an empty folder; its parent is made.

    Raises:
        UnpackError: not a whole zip file; the folder isn't in it; a name in the archive leads out
            of it or is a link; it is larger than photographs are; or the disk can't take it.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = _members(opened, archive, folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            # Beside the target, so that a rename moves it; inside, as the umask leaves it.
            with tempfile.TemporaryDirectory(dir=target.parent, prefix=".unpacking-") as temporary:
                made = Path(temporary) / target.name
                for member in progress(members, f"unpacking {folder}", "file"):
                    inside = PurePosixPath(member.filename).relative_to(folder)
                    _write(opened, member, made.joinpath(*inside.parts))
                made.rename(target)
    except UnpackError:
        raise
    except OSError as error:
        raise UnpackError(f"{archive}: can't be unpacked into {target} ({error})") from error
    except Exception as error:  # a damaged archive leads zipfile to nearly any
        raise UnpackError(f"{archive}: not a whole zip archive ({error}); delete it") from error


def _members(opened: zipfile.ZipFile, archive: Path, folder: str) -> list[zipfile.ZipInfo]:
    """The files in `folder`, after a look at every name: one bad name spoils the archive."""
    for member in opened.infolist():
        if why := _bad(member):
            raise UnpackError(f"{archive}: {member.filename!r} in it {why}; nothing was unpacked")
    inside = f"{folder}/"
    members = [m for m in opened.infolist() if m.filename.startswith(inside) and not m.is_dir()]
    if not members:
        raise UnpackError(f"{archive}: no folder {folder} in it")
    names = {member.filename.casefold() for member in members}
    size, packed = sum(m.file_size for m in members), sum(m.compress_size for m in members)
    excess = {
        "holds two files of one name": len(names) < len(members),
        f"holds {len(members)} files": len(members) > _MOST_FILES,
        f"unpacks to {size} bytes": size > _MOST_BYTES,
        f"unpacks {packed} bytes to {size}": size > _MOST_RATIO * max(packed, 1),
    }
    if wrong := [text for text, holds in excess.items() if holds]:
        raise UnpackError(f"{archive}: {folder} {wrong[0]}: that is no folder of photographs")
    return members


def _bad(member: zipfile.ZipInfo) -> str:
    """Why a member is not to be unpacked, or nothing."""
    name, mode = member.filename, member.external_attr >> 16
    parts = name.removesuffix("/").split("/")
    if name.startswith("/") or "\\" in name or ":" in name or "\0" in member.orig_filename:
        return "is no relative path"
    if any(part in ("", ".", "..") for part in parts):
        return "leads out of its folder"
    if any(_DEVICES.fullmatch(part) or not part.isprintable() for part in parts):
        return "is no name for a file"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a link or a device"
    return "is encrypted" if member.flag_bits & _ENCRYPTED else ""


def _write(opened: zipfile.ZipFile, member: zipfile.ZipInfo, file: Path) -> None:
    """Unpack one file; zipfile reads no more than its header declares, and checks its CRC."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with opened.open(member) as source, file.open("xb") as stream:
        shutil.copyfileobj(source, stream, _CHUNK)
