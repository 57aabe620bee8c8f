"""Reads the reports of scenes that could not be made into a variant.

Such a scene leaves a folder `failed-<key>` among the variants: `report.json` says how SfM went and
why the scene failed, and `colmap.log` is COLMAP's log.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import StoreError
from xrgs.safeio.records import read_object

if TYPE_CHECKING:
    from pathlib import Path

#: The beginning of the name of a failed scene's folder; the key of its variant follows.
FAILED_PREFIX = "failed-"


def failed_scenes(variants: Path, key: str = "*") -> dict[str, tuple[str, str]]:
    """List the scenes that could not be made into a variant.

    Args:
        variants: The store's folder of variants.
        key: The key of the only variant to look for; by default all are listed.

    Returns:
        The scene's name and the reason, by the key of the variant. Unreadable reports are left out.
    """
    failed = {}
    for folder in sorted(variants.glob(f"{FAILED_PREFIX}{key}")):
        try:
            report = read_object(folder / "report.json")
            failed[folder.name.removeprefix(FAILED_PREFIX)] = (
                str(report["scene"]),
                str(report["reason"]),
            )
        except (StoreError, KeyError):
            continue
    return failed
