"""Reads the reports of scenes that could not be made into a variant.

Such a scene leaves a folder `failed-<key>` among the variants: `report.json` says how SfM went and
why the scene failed, and `colmap.log` is COLMAP's log.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import StoreError
from xrgs.safeio.confined import confined
from xrgs.safeio.records import read_object

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.safeio.confined import ConfinedPath

#: The beginning of the name of a failed scene's folder; the key of its variant follows.
FAILED_PREFIX = "failed-"


def read_failure(folder: ConfinedPath) -> tuple[str, str]:
    """Read which scene could not be made into a variant, and why.

    Args:
        folder: The folder `failed-<key>`.

    Returns:
        The scene's name and the reason.

    Raises:
        UnreadableError: The report can't be read now.
        StoreError: The report is missing or damaged.
    """
    file = folder / "report.json"
    report = read_object(file)
    scene, reason = report.get("scene"), report.get("reason")
    if not isinstance(scene, str) or not isinstance(reason, str):
        raise StoreError(f"{file}: it has no scene or no reason")
    return scene, reason


def failed_scenes(variants: Path | ConfinedPath) -> dict[str, tuple[str, str]]:
    """List the scenes that could not be made into a variant.

    Args:
        variants: The store's folder of variants.

    Returns:
        The scene's name and the reason, by the key of the variant. Where the report can't be read,
        the scene is `?` and the reason says why.

    Raises:
        OSError: The folder can't be read; it may be missing.
    """
    folder = confined(variants)
    failed = {}
    for name in folder.folders():
        if not name.startswith(FAILED_PREFIX):
            continue
        try:
            why = read_failure(folder / name)
        except StoreError as error:
            why = "?", str(error)
        failed[name.removeprefix(FAILED_PREFIX)] = why
    return failed
