"""Provides the photographs of a scene: of a folder, or of a scene embedded in this package.

Nothing here imports torch before an embedded scene is rendered.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from xrgs.capture.scenes import folder, motorcycle, procedural
from xrgs.capture.scenes.rendered import provide, verify
from xrgs.capture.scenes.scene import Scene
from xrgs.errors import XrgsError
from xrgs.safeio.confined import ConfinedPath
from xrgs.safeio.paths import user_path
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from xrgs.config import SceneConf

__all__ = ["Scene", "fingerprint", "label", "resolve", "verify"]

_KINDS = ("procedural", "motorcycle", "folder")


def label(conf: SceneConf) -> str:
    """Return the scene's name in tables.

    Args:
        conf: The scene's config.

    Returns:
        `scene.name`; where that is empty, the name of the folder, or the kind of the scene. It is
        one line of at most 200 characters that can be printed.
    """
    name = conf.name or (user_path(conf.path).resolve().name if conf.path else "")
    return for_line(name, 200).strip() or conf.kind


def fingerprint(conf: SceneConf, long_side: int = 0) -> str:
    """Hash the photographs of a scene, without rendering or decoding them.

    Args:
        conf: The scene's config.
        long_side: `variant.long_side`: the longer side of the HR views, px; 0 for the full size. A
            folder may hold copies of several sizes, and the procedural scene is rendered in it.

    Returns:
        16 hexadecimal digits.

    Raises:
        XrgsError: The kind is unknown, or the photographs are not there.
    """
    _check(conf)
    if conf.kind == "folder":
        content = folder.files_digest(folder.list_photographs(conf.path, long_side))
    elif conf.kind == "motorcycle":
        calibration = repr([(n, k.tolist()) for n, k in motorcycle.intrinsics().items()])
        content = folder.files_digest(motorcycle.files()) + calibration
    else:
        content = procedural.digest(long_side, conf.views)
    return hashlib.sha256(f"{conf.kind}\0{content}".encode()).hexdigest()[:16]


def resolve(conf: SceneConf, cache: ConfinedPath, long_side: int = 0) -> Scene:
    """Find a scene's photographs on disk; the procedural scene is rendered where it is not.

    Args:
        conf: The scene's config.
        cache: The folder of rendered scenes; each has a folder of its own, named by its
            fingerprint.
        long_side: As for `fingerprint`.

    Returns:
        The scene.

    Raises:
        UnreadableError: The rendered scene is there, but can't be read now.
        XrgsError: The kind is unknown, or the photographs are not there.
    """
    name, scene_hash = label(conf), fingerprint(conf, long_side)
    if conf.kind == "folder":
        files = folder.list_photographs(conf.path, long_side)
        return Scene(name, scene_hash, tuple(map(ConfinedPath, files)))
    if conf.kind == "motorcycle":
        known, exact = motorcycle.intrinsics(), motorcycle.viewmats()
        return Scene(name, scene_hash, tuple(map(ConfinedPath, motorcycle.files())), known, exact)
    names, home = procedural.names(conf.views), cache / scene_hash
    provide(home, [f"{n}.png" for n in names], lambda work: _render(work, long_side, conf.views))
    exact = dict(zip(names, procedural.viewmats(conf.views), strict=True))
    # The intrinsics are known too, but SfM estimates them, as for a real capture.
    return Scene(name, scene_hash, tuple(home / f"{n}.png" for n in names), viewmats=exact)


def _check(conf: SceneConf) -> None:
    if conf.kind not in _KINDS:
        raise XrgsError(f"scene.kind={conf.kind}: unknown; must be one of {', '.join(_KINDS)}")
    if conf.kind == "procedural" and conf.views < 2:
        raise XrgsError(f"scene.views={conf.views}: must be 2 or more")


def _render(folder: ConfinedPath, long_side: int, views: int) -> None:
    from xrgs.capture.scenes import still_life  # imports torch

    still_life.render(folder, long_side, views)
