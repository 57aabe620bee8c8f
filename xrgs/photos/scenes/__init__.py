"""Provides the photographs of a scene: of a folder, a video, or a scene embedded in this package.

Nothing here imports torch before an embedded scene is rendered.
"""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from xrgs.config import SceneConf
from xrgs.errors import XrgsError
from xrgs.photos import masks
from xrgs.photos.scenes.folder import list_photographs
from xrgs.photos.scenes.kinds import KINDS, MADE, code_of
from xrgs.photos.scenes.rendered import verify
from xrgs.photos.scenes.scene import Scene, SceneKind, files_digest, label
from xrgs.safeio.paths import user_path
from xrgs.safeio.refactorings import ABSENT

__all__ = [
    "KINDS",
    "Scene",
    "check_labels",
    "code_of",
    "fingerprint",
    "label",
    "names",
    "resolve",
    "verify",
]

#: Kinds whose photographs are in this package, or are rendered by it.
_EMBEDDED = ("procedural", "motorcycle")
#: The values of `scene.alpha`. The first is the default, which is in no fingerprint.
ALPHA = ("composite", "mask")


def check_labels(confs: Iterable[SceneConf]) -> None:
    """Refuse scenes of different photographs that tables would show under one name.

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
    """Return the names of a scene's photographs, see `SceneKind.names`."""
    return _kind(conf).names(conf, long_side)


def fingerprint(conf: SceneConf, long_side: int = 0) -> str:
    """Hash the photographs of a scene and the code that provides them: 16 hexadecimal digits.

    Nothing is rendered or decoded for it. `long_side` is `variant.long_side`, the longer side of
    the HR views, px, 0 for the full size: it chooses among copies of several sizes in a folder, and
    the procedural scene is rendered at this size.

    Raises:
        XrgsError: The kind is unknown, a value is out of its range, or the photographs are not
            there.
    """
    if conf.alpha not in ALPHA:
        raise XrgsError(f"scene.alpha={conf.alpha}: must be one of {', '.join(ALPHA)}")
    if not all(0 <= value <= 1 for value in conf.background):
        raise XrgsError(f"scene.background={list(conf.background)}: values must be 0 to 1")
    content = f"{conf.kind}\0{_kind(conf).digest(conf, long_side)}"
    if conf.kind not in MADE and (code := code_of(conf.kind)) != ABSENT:
        content += f"\0{code}"
    if (conf.alpha, *conf.background) != (ALPHA[0], 0, 0, 0):
        content += f"\0{conf.alpha}\0{list(conf.background)}"
    if conf.masks is not None:
        content += f"\0{files_digest(_masks(conf, long_side)[0])}"
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def resolve(conf: SceneConf, cache: Path, long_side: int = 0) -> Scene:
    """Find a scene's photographs on disk; extract a video's frames, render the procedural scene.

    In `cache` each rendered scene has a folder of its own, named by its fingerprint.

    Raises:
        UnreadableError: The photographs are there, but can't be read now.
        XrgsError: The kind is unknown, or the photographs or their masks are not there.
    """
    found = _kind(conf).resolve(conf, long_side, cache / fingerprint(conf, long_side))
    given, notes = _masks(conf, long_side)
    return replace(
        found,
        alpha=conf.alpha,
        background=conf.background,
        masks=given,
        notes=(*found.notes, *notes),
    )


def _masks(conf: SceneConf, long_side: int) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return the masks by the names of the photographs, and notes on them."""
    if conf.masks is None:
        return {}, ()
    if conf.kind == "folder":
        return masks.find(conf.masks, list_photographs(conf.path, long_side, conf.masks))
    return masks.find(conf.masks, dict.fromkeys(names(conf, long_side), Path()))


def _kind(conf: SceneConf) -> SceneKind:
    if conf.kind not in KINDS:
        raise XrgsError(f"scene.kind={conf.kind}: must be one of {', '.join(KINDS)}")
    if conf.path is not None and conf.kind in _EMBEDDED:
        word = shlex.quote(f"scene.path={conf.path}")
        raise XrgsError(
            f"scene.path={conf.path}: the embedded scene {conf.kind} has no path; for photographs"
            f" write scene=folder {word}, and for a video scene=video {word}"
        )
    return KINDS[conf.kind]
