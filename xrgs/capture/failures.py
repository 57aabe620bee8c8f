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


def failed_scenes(variants: Path | ConfinedPath, key: str = "") -> dict[str, tuple[str, str]]:
    """List the scenes that could not be made into a variant.

    Args:
        variants: The store's folder of variants.
        key: The key of the only variant to look for; empty lists all.

    Returns:
        The scene's name and the reason, by the key of the variant. Where the report can't be read,
        the scene is `?` and the reason says why.

    Raises:
        OSError: The folder can't be read; it may be missing.
    """
    folder = confined(variants)
    names = [f"{FAILED_PREFIX}{key}"] if key else folder.folders()
    failed = {}
    for name in names:
        if not name.startswith(FAILED_PREFIX) or (key and not (folder / name).is_dir()):
            continue
        try:
            report = read_object(folder / name / "report.json")
            why = str(report["scene"]), str(report["reason"])
        except (StoreError, KeyError) as error:
            why = "?", f"{folder / name / 'report.json'}: {error}"
        failed[name.removeprefix(FAILED_PREFIX)] = why
    return failed
