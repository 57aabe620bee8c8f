"""Keeps rendered photographs of a scene in a folder named by the scene's fingerprint.

`scene.json` is written last, with the fingerprint and the hash of every image. Nothing here imports
torch.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import TYPE_CHECKING

from xrgs.capture import sealed
from xrgs.errors import StoreError, UnreadableError
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import confined
from xrgs.safeio.records import read_object
from xrgs.safeio.untrusted import is_name
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from xrgs.safeio.confined import ConfinedPath

_log = logging.getLogger(__name__)
_MANIFEST = "scene.json"


def provide(
    home: ConfinedPath, images: Collection[str], render: Callable[[ConfinedPath], None]
) -> None:
    """Verify rendered images, and render them where they are not there or damaged.

    Any number of processes may call this at once. A damaged folder is renamed, not removed.

    Args:
        home: The folder, named by the scene's fingerprint; the one above it is made where it is
            missing.
        images: The names of the image files.
        render: Writes them into the folder that it is given.

    Raises:
        UnreadableError: The folder is there, but can't be read now.
    """
    home.make_parent()
    with sealed.lock(home.with_name(f".{home.name}.lock")):
        try:
            missing = not home.exists()
        except OSError as error:
            raise UnreadableError(f"{home}: {error.strerror}; try again") from error
        damage = None if missing else _damage(home, images)
        if isinstance(damage, UnreadableError):
            raise UnreadableError(f"{damage}; try again")
        if damage is not None:
            aside = sealed.set_aside(home)
            _log.warning("%s; renamed to %s, and rendered anew", damage, aside.name)
        if missing or damage is not None:
            _render(home, images, render)


def _damage(home: ConfinedPath, images: Collection[str]) -> StoreError | None:
    """Return the first thing that is wrong with a rendered scene; None where it is intact."""
    try:
        files = _files(home)
    except StoreError as error:
        return error
    if files.keys() != set(images):
        return StoreError(f"{home / _MANIFEST}: its files are not the views of this scene")
    return next(sealed.changed(home, files), None)


def _files(home: ConfinedPath) -> dict[str, str]:
    """Read the hash of each file from `scene.json`.

    Raises:
        StoreError: It is missing, can't be read or is malformed.
    """
    file = home / _MANIFEST
    content = read_object(file)
    files = content.get("files")
    if not isinstance(files, dict) or not all(
        is_name(name) and isinstance(sha256, str) for name, sha256 in files.items()
    ):
        raise StoreError(f"{file}: it has no list of files")
    if content.get("fingerprint") != sealed.own_name(home):
        raise StoreError(f"{file}: it is of another scene than its folder's name says")
    return files


def _render(
    home: ConfinedPath, images: Collection[str], render: Callable[[ConfinedPath], None]
) -> None:
    """Render into another folder, after what a killed process left of it is removed."""
    work = home.with_name(f".{home.name}.rendering")
    work.remove()
    work.make_folder()
    try:
        render(work)
        content = {"fingerprint": home.name, "files": sealed.hashes(work, sorted(images))}
        write_json(work / _MANIFEST, content, durable=False)
        work.sync_tree()
        work.rename(home)
    except BaseException:
        with suppress(OSError):
            work.remove()
        raise
    home.sync_name()


def verify(path: Path | ConfinedPath) -> list[str]:
    """Say everything that is wrong with the files of a rendered scene.

    Args:
        path: The scene's folder in the store's `scenes/`, which may come from anybody.

    Returns:
        A line for each file that is missing, has changed, can't be read now or does not belong
        there; empty for an intact scene.
    """
    home = confined(path)
    try:
        files = _files(home)
    except StoreError as error:
        return [for_line(str(error))]
    errors = [*sealed.changed(home, files), *sealed.unlisted(home, {_MANIFEST, *files})]
    return [for_line(str(error)) for error in errors]
