"""Where photographs come from: embedded scenes and folders. Light until a scene is resolved."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.capture.scenes import folder, motorcycle, procedural
from xrgs.capture.scenes.scene import Scene
from xrgs.errors import XrgsError
from xrgs.safeio.atomic import path_of

if TYPE_CHECKING:
    from xrgs.config import SceneConf

__all__ = ["Scene", "fingerprint", "label", "resolve"]

_KINDS = ("procedural", "motorcycle", "folder")


def label(conf: SceneConf) -> str:
    """The scene's name in tables: `scene.name`, or where that is empty the folder's own name."""
    if conf.name:
        return conf.name
    return path_of(conf.path).resolve().name if conf.path else conf.kind


def fingerprint(conf: SceneConf, long_side: int = 0) -> str:
    """Hash of what the photographs are, 16 hex digits, without rendering or decoding them.

    Args:
        conf: The scene.
        long_side: Longer side that is wanted, px; 0 is the full size. A folder may hold several
            sizes, and the procedural scene is rendered at the size asked for.

    Raises:
        XrgsError: an unknown kind, or photographs that are not there.
    """
    _check(conf)
    if conf.kind == "folder":
        content = folder.digest(folder.photographs(conf.path, long_side))
    elif conf.kind == "motorcycle":
        calibration = repr([(n, k.tolist()) for n, k in motorcycle.intrinsics().items()])
        content = folder.digest(motorcycle.files()) + calibration
    else:
        content = procedural.digest(long_side, conf.views)
    return hashlib.sha256(f"{conf.kind}\0{content}".encode()).hexdigest()[:16]


def resolve(conf: SceneConf, cache: Path, long_side: int = 0) -> Scene:
    """The scene's photographs on disk; an embedded scene is rendered into `cache` the first time.

    Args:
        conf: The scene.
        cache: Folder of rendered scenes; each has one of its own, named by its fingerprint.
        long_side: As in `fingerprint`.

    Raises:
        XrgsError: an unknown kind, or photographs that are not there.
    """
    name, mark = label(conf), fingerprint(conf, long_side)
    if conf.kind == "folder":
        return Scene(name, mark, folder.photographs(conf.path, long_side))
    if conf.kind == "motorcycle":
        known, exact = motorcycle.intrinsics(), motorcycle.viewmats()
        return Scene(name, mark, motorcycle.files(), known, exact)
    names = procedural.names(conf.views)
    home = cache / mark
    if not home.is_dir():
        _render(conf, home, long_side)
    exact = dict(zip(names, procedural.viewmats(conf.views), strict=True))
    # The intrinsics are known too, but SfM is to find them, as in a real capture.
    return Scene(name, mark, tuple(home / f"{n}.png" for n in names), viewmats=exact)


def _check(conf: SceneConf) -> None:
    if conf.kind not in _KINDS:
        raise XrgsError(f"scene.kind={conf.kind}: unknown; one of {', '.join(_KINDS)}")
    if conf.kind == "procedural" and conf.views < 2:
        raise XrgsError(f"scene.views={conf.views}: two or more are needed")


def _render(conf: SceneConf, home: Path, long_side: int) -> None:
    """Render beside `home` and rename, so that what is there is whole; the first to finish wins."""
    home.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=home.parent, prefix=".rendering-") as temporary:
        made = Path(temporary) / "images"
        from xrgs.capture.scenes import still_life

        still_life.render(made, long_side, conf.views)
        try:
            made.rename(home)
        except OSError:
            if not home.is_dir():
                raise
            shutil.rmtree(made)
