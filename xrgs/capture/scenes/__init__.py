"""Provides the photographs of a scene: of a folder, a video, or a scene embedded in this package.

Nothing here imports torch before an embedded scene is rendered.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from xrgs.capture.scenes import folder, motorcycle, procedural, video
from xrgs.capture.scenes.rendered import provide, verify
from xrgs.capture.scenes.scene import Scene
from xrgs.errors import XrgsError
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from xrgs.config import SceneConf

__all__ = ["Scene", "check_labels", "fingerprint", "label", "names", "resolve", "verify"]

_KINDS = ("procedural", "motorcycle", "folder", "video")


def label(conf: SceneConf) -> str:
    """Return the scene's name in tables.

    Args:
        conf: The scene's config.

    Returns:
        `scene.name`; where that is empty, the name of the folder or the video, or the kind of the
        scene. A folder called `images` has the name of the folder around it. It is one line of at
        most 200 characters that can be printed.
    """
    name = conf.name
    if not name and conf.path:
        path = user_path(conf.path.removesuffix(folder.ALL_BELOW)).resolve()
        name = path.parent.name if path.name == "images" else path.name
    return for_line(name, 200).strip() or conf.kind


def check_labels(confs: Iterable[SceneConf]) -> None:
    """Refuse scenes of different photographs that tables would show under one name.

    Args:
        confs: The scenes of a sweep.

    Raises:
        XrgsError: Two folders or videos have one name; the message names both.
    """
    paths: dict[str, Path] = {}
    for conf in confs:
        if not conf.path:
            continue
        path, name = user_path(conf.path).resolve(), label(conf)
        if paths.setdefault(name, path) != path:
            raise XrgsError(
                f"scene.path={paths[name]} and scene.path={path}: both are called {name} in tables;"
                " rename one, or give each a file in a folder scene/ with a name of its own"
                " (xrgs-sweep --config-dir)"
            )


def names(conf: SceneConf, long_side: int = 0) -> list[str]:
    """Return the names of a scene's photographs, sorted, without reading or rendering them.

    Args:
        conf: The scene's config.
        long_side: As for `fingerprint`.

    Raises:
        XrgsError: The kind is unknown, or the photographs are not there.
    """
    _check(conf)
    if conf.kind == "folder":
        return list(folder.list_photographs(conf.path, long_side))
    if conf.kind == "motorcycle":
        return list(motorcycle.files())
    return video.names(conf.views) if conf.kind == "video" else procedural.names(conf.views)


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
    elif conf.kind == "video":
        content = video.digest(conf.path, conf.views)
    else:
        content = procedural.digest(long_side, conf.views)
    return hashlib.sha256(f"{conf.kind}\0{content}".encode()).hexdigest()[:16]


def resolve(conf: SceneConf, cache: Path, long_side: int = 0) -> Scene:
    """Find a scene's photographs on disk; frames and rendered views are made where they are not.

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
        return Scene(name, scene_hash, folder.list_photographs(conf.path, long_side))
    if conf.kind == "motorcycle":
        known, exact = motorcycle.intrinsics(), motorcycle.viewmats()
        return Scene(name, scene_hash, motorcycle.files(), known, exact)
    views, home = names(conf), cache / scene_hash
    files = {view: home / f"{view}.png" for view in views}
    provide(home, [file.name for file in files.values()], lambda work: _make(work, conf, long_side))
    if conf.kind == "video":
        return Scene(name, scene_hash, files)
    exact = dict(zip(views, procedural.viewmats(conf.views), strict=True))
    # The intrinsics are known too, but SfM estimates them, as for a real capture.
    return Scene(name, scene_hash, files, viewmats=exact)


def _check(conf: SceneConf) -> None:
    if conf.kind not in _KINDS:
        raise XrgsError(f"scene.kind={conf.kind}: unknown; must be one of {', '.join(_KINDS)}")
    if conf.kind in ("procedural", "video") and conf.views < 2:
        raise XrgsError(f"scene.views={conf.views}: must be 2 or more")


def _make(work: Path, conf: SceneConf, long_side: int) -> None:
    """Write the photographs of a scene that has none on the disk."""
    if conf.kind == "video":
        video.extract(conf.path, conf.views, work)
        return
    from xrgs.capture.scenes import still_life  # imports torch

    still_life.render(work, long_side, conf.views)
