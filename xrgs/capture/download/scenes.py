"""Puts published scenes on this machine: downloads their archive and unpacks their folders."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture.download.exchange import TooLargeError
from xrgs.capture.download.http import download
from xrgs.capture.download.unpack import UnpackError, unpack
from xrgs.capture.scenes.folder import list_photographs
from xrgs.errors import XrgsError
from xrgs.safeio.atomic import write_text
from xrgs.safeio.confined import confined
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from xrgs.capture.download.settings import DatasetConf

#: The folder in the root for archives, complete or partly downloaded.
_DOWNLOADS = ".downloads"
#: The largest record of a hash that is read, in bytes.
_MAX_RECORD_BYTES = 1 << 12


def fetch_scenes(conf: DatasetConf, names: Iterable[str], root: Path) -> str:
    """Put scenes into a folder each; those that are there already are not touched.

    Args:
        conf: The archive.
        names: The names of the scenes; all of the archive where there are none.
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
    digest = _provide_archive(conf, archive, root)
    for scene in missing:
        unpack(archive, f"{conf.folder}/{scene}", root / scene)
        lines.append(f"{root / scene}: {len(list_photographs(str(root / scene), 0))} photographs")
    lines.append(_record_digest(conf, archive, digest))
    return "\n".join([*lines, f"{archive} is no longer needed for these"])


def _has_photographs(scene: Path) -> bool:
    """Tell whether a scene's folder holds photographs; a missing or empty folder does not.

    Raises:
        XrgsError: The folder holds something else, which only its owner may remove.
    """
    if not scene.exists() or (scene.is_dir() and not any(scene.iterdir())):
        return False
    try:
        list_photographs(str(scene), 0)
    except XrgsError as error:
        raise XrgsError(f"{scene} is in the way ({error}): move it, and run this again") from error
    return True


def _provide_archive(conf: DatasetConf, archive: Path, root: Path) -> str:
    """Download the archive where it is missing, verify it, and return its SHA-256."""
    expected, source = conf.sha256.lower(), "sha256 in config"
    if not expected:
        record = _digest_file(archive)
        expected, source = _read_digest(record), f"that of its first use in {record}"
    if not archive.is_file():
        _download(conf, archive, root, expected)
    actual = file_digest(archive)
    if expected and actual != expected:
        raise UnpackError(f"{archive}: its sha256 is {actual}, not {expected}, {source}; delete it")
    return actual


def _download(conf: DatasetConf, archive: Path, root: Path, expected: str) -> None:
    try:
        download(conf.url, archive, conf.max_bytes, expected, conf.redirect_hosts)
    except TooLargeError as error:
        raise XrgsError(f"{error}: if it is the right file, give a larger --max-bytes") from error
    except XrgsError as error:
        record = _digest_file(archive)
        hint = f" ({record} has that of its first use)" if expected and not conf.sha256 else ""
        raise XrgsError(
            f"{error}{hint}. By hand: fetch {conf.file} from {conf.page or conf.url} with a "
            f"browser, put it at {archive} and run this again; or put the scenes' own folders into "
            f"{root}"
        ) from error


def _digest_file(archive: Path) -> Path:
    """Return the file that keeps the archive's SHA-256, as a line that `sha256sum -c` reads."""
    return archive.with_name(f"{archive.name}.sha256")


def _read_digest(record: Path) -> str:
    """Read the archive's SHA-256 at its first use; empty where it was not used before."""
    try:
        content = confined(record).read_bytes(_MAX_RECORD_BYTES).decode("ascii", "replace")
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise XrgsError(f"{record}: can't be read ({error.strerror})") from error
    if not re.fullmatch(r"[0-9a-f]{64}  [^\n]*\n", content):
        raise XrgsError(f"{record}: not a line of sha256sum; remove the file, or mend it")
    return content[:64]


def _record_digest(conf: DatasetConf, archive: Path, digest: str) -> str:
    """Keep the hash of an archive that was unpacked without an error; say how it was verified."""
    record = _digest_file(archive)
    is_first = not conf.sha256 and not _read_digest(record)
    try:
        write_text(record, f"{digest}  {archive.name}\n")
    except OSError as error:
        raise XrgsError(f"{record}: can't be written ({error.strerror})") from error
    if is_first:
        return (
            f"{archive}: sha256 not verified: none in config. It is {digest}, from now on verified "
            f"by {record}; --sha256 {digest} verifies it elsewhere"
        )
    return f"{archive}: sha256 verified: {digest}"
