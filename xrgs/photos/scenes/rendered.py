"""Keeps rendered photographs of a scene in a folder named by the scene's fingerprint.

`scene.json` is written last, with the fingerprint and the hash of every image. Nothing here imports
torch.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from msgspec import Struct

from xrgs.errors import StoreError, UnreadableError
from xrgs.runtime import lease
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import remove_path, sync_name, sync_tree
from xrgs.safeio.records import read_struct
from xrgs.safeio.sanitize import for_line

_log = logging.getLogger(__name__)
_MANIFEST = "scene.json"


class RenderedScene(Struct, frozen=True):
    """The content of `scene.json`."""

    fingerprint: str
    files: dict[str, str]
    """The SHA-256 of each image by its name."""


def provide(home: Path, views: Sequence[str], render: Callable[[Path], None]) -> dict[str, Path]:
    """Verify rendered images, and render them if they are missing or damaged.

    Any number of processes may call this at once. A damaged folder is renamed, not removed.

    Args:
        home: The scene's folder, named by its fingerprint; its parent is made if missing.
        views: The names of the views.
        render: Writes `<view>.png` for each view into the folder that it is given.

    Raises:
        UnreadableError: The folder is there, but can't be read now.
    """
    images = [f"{view}.png" for view in views]
    home.parent.mkdir(exist_ok=True)
    with lease.waited_for(home.parent, f".{home.name}.lock"):
        try:
            missing = not home.exists()
        except OSError as error:
            raise UnreadableError(f"{home}: {error.strerror}; try again") from error
        damage = None if missing else _damage(home, images)
        if isinstance(damage, UnreadableError):
            raise UnreadableError(f"{damage}; try again")
        if damage is not None:
            aside = checksums.set_aside(home)
            _log.warning("%s; renamed to %s, and rendered anew", damage, aside.name)
        if missing or damage is not None:
            _render(home, images, render)
    return {view: home / f"{view}.png" for view in views}


def _damage(home: Path, images: Sequence[str]) -> StoreError | None:
    """Return the first error of a rendered scene; None if it is intact."""
    try:
        files = _files(home)
    except StoreError as error:
        return error
    if files.keys() != set(images):
        return StoreError(f"{home / _MANIFEST}: its files are not the views of this scene")
    return next(checksums.changed(home, files), None)


def _files(home: Path) -> dict[str, str]:
    """Read the hash of each file from `scene.json`; StoreError if it is missing or damaged."""
    file = home / _MANIFEST
    content = read_struct(file, RenderedScene)
    if content.fingerprint not in {home.name, home.resolve().name}:
        raise StoreError(f"{file}: its fingerprint is not the name of its folder")
    return content.files


def _render(home: Path, images: Sequence[str], render: Callable[[Path], None]) -> None:
    """Render into a temporary folder and rename it; first remove what a killed process left."""
    work = home.with_name(f".{home.name}.rendering")
    remove_path(work)
    work.mkdir()
    try:
        render(work)
        content = {"fingerprint": home.name, "files": checksums.hashes(work, sorted(images))}
        write_json(work / _MANIFEST, content, durable=False)
        sync_tree(work)
        work.rename(home)
    except BaseException:
        with suppress(OSError):
            remove_path(work)
        raise
    sync_name(home)


def verify(home: Path) -> list[str]:
    """Return a line for each file of a rendered scene that is wrong; none for an intact scene.

    A file is wrong if it is missing, has changed, can't be read now or does not belong there.
    """
    try:
        files = _files(home)
    except StoreError as error:
        return [for_line(str(error))]
    errors = [*checksums.changed(home, files), *checksums.unlisted(home, {_MANIFEST, *files})]
    return [for_line(str(error)) for error in errors]
