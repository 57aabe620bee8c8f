"""Puts published scenes on this machine: downloads their archive and unpacks their folders."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture.download.http import TooLargeError, download
from xrgs.capture.download.unpack import UnpackError, unpack
from xrgs.capture.scenes.folder import list_photographs
from xrgs.errors import XrgsError
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from xrgs.capture.download.settings import DatasetConf

#: The folder in the root for archives, complete or partly downloaded.
_DOWNLOADS = ".downloads"


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
    lines.append(_provide_archive(conf, archive, root))
    for scene in missing:
        unpack(archive, f"{conf.folder}/{scene}", root / scene)
        lines.append(f"{root / scene}: {len(list_photographs(str(root / scene), 0))} photographs")
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
    """Download the archive where it is missing, verify it, and say whether its hash was checked."""
    if archive.is_file():
        if conf.sha256 and file_digest(archive) != conf.sha256.lower():
            raise UnpackError(f"{archive}: its sha256 is not the config's {conf.sha256}; delete it")
    else:
        try:
            download(conf.url, archive, conf.max_bytes, conf.sha256)
        except TooLargeError as error:
            raise XrgsError(
                f"{error}: if it is the right file, give a larger max_bytes="
            ) from error
        except XrgsError as error:
            raise XrgsError(
                f"{error}. By hand: fetch {conf.file} from {conf.page or conf.url} with a browser, "
                f"put it at {archive} and run this again; or put the scenes' own folders into "
                f"{root}"
            ) from error
    verified = "sha256 verified" if conf.sha256 else "sha256 not verified: none in config"
    return f"{archive}: {verified}"
