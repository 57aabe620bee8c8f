"""Published scenes on this machine: an archive is downloaded, and the wanted folders unpacked."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture.download.http import TooLargeError, download
from xrgs.capture.download.unpack import UnpackError, unpack
from xrgs.capture.scenes.folder import photographs
from xrgs.errors import XrgsError
from xrgs.safeio.hashing import file_digest

if TYPE_CHECKING:
    from xrgs.capture.download.settings import DatasetConf

#: In the root: archives, and what came of those that are not whole.
_DOWNLOADS = ".downloads"


def get(conf: DatasetConf, wanted: Iterable[str], root: Path) -> str:
    """Put scenes into `root`, a folder each; those that are there are not touched.

    Args:
        conf: The archive.
        wanted: Names of scenes; none means all that it holds.
        root: The folder that `scene=llff/...` looks in, `data_root`.

    Returns:
        What was done, a line a scene.

    Raises:
        XrgsError: an unknown scene, a folder in the way, or an archive that can't be had; the
            message says what to do by hand.
    """
    scenes = list(dict.fromkeys(wanted)) or list(conf.scenes)
    for scene in scenes:
        if scene not in conf.scenes:
            raise XrgsError(f"{scene}: no such scene; {conf.file} holds {', '.join(conf.scenes)}")
    missing = [scene for scene in scenes if not _is_there(root / scene)]
    lines = [f"{root / scene}: there already" for scene in scenes if scene not in missing]
    if not missing:
        return "\n".join(lines)
    archive = root / _DOWNLOADS / conf.file
    lines.append(_archive(conf, archive, root))
    for scene in missing:
        unpack(archive, f"{conf.folder}/{scene}", root / scene)
        lines.append(f"{root / scene}: {len(photographs(str(root / scene), 0))} photographs")
    return "\n".join([*lines, f"{archive} is no longer needed for these"])


def _is_there(scene: Path) -> bool:
    """Whether a scene's folder holds photographs.

    Raises:
        XrgsError: it holds something else; it is not ours to remove.
    """
    if not scene.exists() or (scene.is_dir() and not any(scene.iterdir())):
        return False
    try:
        photographs(str(scene), 0)
    except XrgsError as error:
        raise XrgsError(f"{scene} is in the way ({error}): move it, and run this again") from error
    return True


def _archive(conf: DatasetConf, archive: Path, root: Path) -> str:
    """Have the archive at its place, and say how far it was verified."""
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
