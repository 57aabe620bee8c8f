"""Puts published scenes on this machine: downloads their archive and unpacks their folders."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from xrgs.errors import XrgsError
from xrgs.photos.download.http import DownloadError, NotAllowedError, download
from xrgs.photos.scenes.folder import list_photographs
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import write_text
from xrgs.safeio.files import sync_name, sync_tree
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.sanitize import for_line

#: The folder in the root for archives, complete or partly downloaded.
_DOWNLOADS = ".downloads"
#: Limits for one folder: unpacked bytes, far more than the largest LLFF scene has, and files.
_MAX_BYTES = 8 << 30
_MAX_FILES = 10_000


@dataclass
class DatasetConf:
    """One archive of scenes, each in a folder of its own; `conf/data/` explains the keys."""

    url: str
    page: str
    file: str
    max_bytes: int
    sha256: str
    redirect_hosts: list[str]
    folder: str
    scenes: list[str]


def fetch_scenes(conf: DatasetConf, names: Iterable[str], root: Path) -> str:
    """Put each scene into a folder of its own; scenes that are there already are not touched.

    Args:
        conf: The archive.
        names: The names of the scenes; empty for all scenes of the archive.
        root: The folder to put them into: `data_root`, in which `scene=llff/...` looks.

    Returns:
        What was done, one line per scene.

    Raises:
        XrgsError: A scene is not in the archive, a folder is in the way, or the archive can't be
            downloaded or unpacked; the message says what to do by hand.
    """
    scenes = list(dict.fromkeys(names)) or list(conf.scenes)
    for scene in scenes:
        if scene not in conf.scenes:
            raise XrgsError(f"{scene}: no such scene; {conf.file} holds {', '.join(conf.scenes)}")
    missing = [scene for scene in scenes if not _has_photographs(root / scene)]
    lines = [f"{root / scene}: there already" for scene in scenes if scene not in missing]
    if not missing:
        return "\n".join(lines)
    archive = root / _DOWNLOADS / conf.file
    record = archive.with_name(f"{archive.name}.sha256")
    is_first_use = not conf.sha256 and not record.exists()
    digest = _provide_archive(conf, archive, record)
    for scene in missing:
        unpack(archive, f"{conf.folder}/{scene}", root / scene)
        lines.append(f"{root / scene}: {len(list_photographs(str(root / scene), 0))} photographs")
    # Only now: an archive that can't be unpacked is not trusted. `sha256sum -c` reads this line.
    write_text(record, f"{digest}  {archive.name}\n")
    if is_first_use:
        lines.append(
            f"{archive}: sha256 not verified: none in config. It is {digest}, from now on verified "
            f"by {record}; --sha256 {digest} verifies it elsewhere"
        )
    else:
        lines.append(f"{archive}: sha256 verified: {digest}")
    return "\n".join([*lines, f"{archive} is no longer needed for these"])


def _has_photographs(scene: Path) -> bool:
    """Tell whether a scene's folder holds photographs; a missing or empty folder does not.

    It raises XrgsError if the folder holds something else, which only its owner may remove.
    """
    if not scene.exists() or (scene.is_dir() and not any(scene.iterdir())):
        return False
    try:
        list_photographs(str(scene), 0)
    except XrgsError as error:
        raise XrgsError(f"{scene} is in the way ({error}): move it, and run this again") from error
    return True


def _provide_archive(conf: DatasetConf, archive: Path, record: Path) -> str:
    """Download the archive if it is missing, verify it, and return its SHA-256."""
    expected, source = conf.sha256.lower(), "the sha256 in config"
    if not expected and record.exists():
        expected, source = record.read_text().split(" ")[0], f"the sha256 at first use in {record}"
    try:
        if not archive.exists():
            download(conf.url, archive, conf.max_bytes, expected, conf.redirect_hosts)
    except DownloadError as error:
        hint = f" (expected: {source})" if expected else ""
        if isinstance(error, NotAllowedError):
            hint += "; --max-bytes and --redirect-hosts allow more"
        raise XrgsError(
            f"{error}{hint}. By hand: fetch {conf.file} from {conf.page or conf.url} with a "
            f"browser, put it at {archive} and run this again; or put the scenes' own folders into "
            f"{archive.parent.parent}"
        ) from error
    actual = file_digest(archive)
    if expected and actual != expected:
        raise UnpackError(f"{archive}: its sha256 is {actual}, not {expected}, {source}; delete it")
    return actual


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
