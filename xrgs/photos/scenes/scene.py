"""The common parts of all kinds of scenes: the dataclass, the protocol of a kind, and checks."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from xrgs.config import SceneConf
from xrgs.errors import UnreadableError, XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line

_Read = TypeVar("_Read")

#: The end of a `scene.path` that includes all folders below.
ALL_BELOW = "/**"
#: `remembered` keeps a result once the file has been unchanged for this long, ns; FAT's times have
#: a resolution of two seconds.
_SETTLED_NS = 2 * 10**9


@dataclass(frozen=True)
class Scene:
    """The photographs of a scene, and the cameras if they are known.

    The key of all mappings is the name of a photograph, which is also the name of its view.
    """

    name: str
    """The name of the scene in tables."""
    fingerprint: str
    """A hash of the photographs' names and bytes, or of the code and values that render them."""
    files: Mapping[str, Path]
    """The photographs, sorted by name."""
    intrinsics: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Exact intrinsics [3, 3] in px of the file, without distortion; SfM gets them, and does not
    refine them."""
    viewmats: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Exact world-to-camera matrices [4, 4]. SfM never gets them: its poses are compared with
    them."""
    masks: Mapping[str, Path] = field(default_factory=dict)
    """The mask of each photograph that has one; white pixels are used."""
    alpha: str = "composite"
    """`composite` lays transparent pixels over `background`; `mask` leaves them out."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB in 0..1."""
    notes: tuple[str, ...] = ()
    """Sentences on what was left out of the scene, for the variant's report."""


class SceneKind(Protocol):
    """A source of photographs.

    A new kind is one module of this folder, named after the value of `scene.kind`, and one line in
    `xrgs.photos.scenes.kinds.KINDS`. The key of a variant includes what `digest` returns and the
    code of its own kind only.
    """

    def names(self, conf: SceneConf, long_side: int) -> list[str]:
        """Return the names of the photographs, sorted, without reading or rendering them.

        `long_side` is `variant.long_side`, px; 0 for the full size. XrgsError names the key if the
        photographs are not there.
        """

    def digest(self, conf: SceneConf, long_side: int) -> str:
        """Hash all that decides the photographs, without decoding or rendering them.

        A kind of `xrgs.photos.scenes.kinds.MADE` hashes its code, too.
        """

    def resolve(self, conf: SceneConf, long_side: int, home: Path) -> Scene:
        """Find the photographs on disk.

        `home` is the folder for photographs that are rendered or extracted, see
        `xrgs.photos.scenes.rendered`. Its name is the scene's fingerprint.
        """


def label(conf: SceneConf) -> str:
    """Return the scene's name in tables: one printable line of at most 200 characters.

    It is `scene.name`; if that is empty, the name of the folder or the video, or else the kind. For
    a folder called `images` it is the name of its parent.
    """
    name = conf.name
    if not name and conf.path:
        name = scene_name(user_path(conf.path.removesuffix(ALL_BELOW)))
    return for_line(name, 200).strip() or conf.kind


def scene_name(path: Path) -> str:
    """Return the name that a folder or a video gives its scene, see `label`."""
    path = path.resolve()
    return path.parent.name if path.name == "images" else path.name


def check_views(conf: SceneConf) -> None:
    """Refuse a `scene.views` below two, for kinds that make their views."""
    if conf.views < 2:
        raise XrgsError(f"scene.views={conf.views}: must be 2 or more")


def files_digest(files: Mapping[str, Path]) -> str:
    """Hash the names and bytes of files, in their order, as `content` does."""
    sha256 = hashlib.sha256()
    for name, file in progress(files.items(), "hashing photographs", "file"):
        sha256.update(f"{name}\0{content(file)}\n".encode())
    return sha256.hexdigest()


def content(file: Path) -> str:
    """Hash the bytes of a photograph: 64 hexadecimal digits of a SHA-256.

    It raises UnreadableError for a file that can't be read now: to leave it out would change the
    scene whenever a disk or a server fails.
    """
    try:
        return _digest(file)
    except OSError as error:
        why = f"{error.strerror}; try again, or move it out of the folder"
        raise UnreadableError(f"{file}: {why}") from error


def remembered(read: Callable[[Path], _Read]) -> Callable[[Path], _Read]:
    """Cache the results of a function of a file, while the file's size and times stay the same.

    A sweep asks several times for names, hashes and sizes of the same photographs.
    """

    @lru_cache(maxsize=1 << 16)
    def of(file: Path, *_: int) -> _Read:
        return read(file)

    def get(file: Path) -> _Read:
        status = file.stat()
        # A file may change twice within the resolution of its times.
        if time.time_ns() - max(status.st_mtime_ns, status.st_ctime_ns) < _SETTLED_NS:
            return read(file)
        return of(file, status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    return get


_digest = remembered(file_digest)


def bundled_photograph(name: str) -> Path:
    """Find a file in the `data` folder of scikit-image's wheel, without importing scikit-image.

    It raises XrgsError if scikit-image, or the file in it, is not installed.
    """
    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        raise XrgsError("scikit-image is not installed: it holds the embedded scenes' photographs")
    path = Path(spec.origin).parent / "data" / name
    if not path.is_file():
        raise XrgsError(f"{path}: missing from this scikit-image, which the embedded scenes need")
    return path
