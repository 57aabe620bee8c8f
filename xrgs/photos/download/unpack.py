"""Unpacks a folder of an untrusted zip archive."""

from __future__ import annotations

import tempfile
import zipfile
from pathlib import Path

from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio.files import sync_name, sync_tree
from xrgs.safeio.sanitize import for_line

#: Limits for one folder: unpacked bytes, far more than the largest LLFF scene has, and files.
_MAX_BYTES = 8 << 30
_MAX_FILES = 10_000


class UnpackError(XrgsError):
    """An archive can't be unpacked, or should not be; the message names it."""


def unpack(archive: Path, folder: str, target: Path) -> None:
    """Write a folder of a zip archive as `target`: all of it, or nothing.

    `target` must not exist, or be empty; its parent is made.

    Raises:
        UnpackError: The archive is damaged; the folder is not in it, leads out of itself or is too
            large; or the files can't be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # In the same file system as the target, so that a rename moves the folder.
        with (
            zipfile.ZipFile(archive) as opened,
            tempfile.TemporaryDirectory(prefix=".unpacking-", dir=target.parent) as made,
        ):
            members = _members(opened, archive, folder)
            for member in progress(members, f"unpacking {folder}", "file"):
                # zipfile reads no more than the declared size, checks the CRC and makes no links.
                opened.extract(member, made)
            sync_tree(Path(made) / folder)
            (Path(made) / folder).rename(target)
            sync_name(target)
    except UnpackError:
        raise
    except OSError as error:
        raise UnpackError(f"{archive}: can't be unpacked into {target} ({error})") from error
    except Exception as error:  # zipfile raises nearly anything on a damaged archive
        why = for_line(str(error))
        raise UnpackError(f"{archive}: not a complete zip archive ({why}); delete it") from error


def _members(opened: zipfile.ZipFile, archive: Path, folder: str) -> list[zipfile.ZipInfo]:
    """List the files in `folder`."""
    inside = f"{folder}/"
    members = [m for m in opened.infolist() if m.filename.startswith(inside) and not m.is_dir()]
    if not members:
        raise UnpackError(f"{archive}: there is no folder {folder} in it")
    for member in members:
        if ".." in member.filename.split("/"):
            raise UnpackError(f"{archive}: {member.filename!r} in it leads out of its folder")
    size = sum(member.file_size for member in members)
    if size > _MAX_BYTES or len(members) > _MAX_FILES:
        raise UnpackError(
            f"{archive}: {folder} unpacks to {len(members)} files and {size} bytes; at most "
            f"{_MAX_FILES} and {_MAX_BYTES} are allowed"
        )
    return members
