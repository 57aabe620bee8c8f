"""Reads the reports of scenes that could not be made into a variant.

Such a scene leaves a folder `failed-<key>` among the variants: `report.json` says how SfM went and
why the scene failed, and `colmap.log` is COLMAP's log.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from xrgs.errors import StoreError
from xrgs.safeio.files import list_names
from xrgs.safeio.records import read_struct

if TYPE_CHECKING:
    from pathlib import Path


#: The beginning of the name of a failed scene's folder; the key of its variant follows.
FAILED_PREFIX = "failed-"


class _FailureReport(Struct):
    """What is read of `report.json`; the rest says how SfM went."""

    scene: str
    reason: str


def read_failure(folder: Path) -> tuple[str, str]:
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
    report = read_struct(file, _FailureReport)
    return report.scene, report.reason


def failed_scenes(variants: Path) -> dict[str, tuple[str, str]]:
    """List the scenes that could not be made into a variant.

    Args:
        variants: The store's folder of variants.

    Returns:
        The scene's name and the reason, by the key of the variant. Where the report can't be read,
        the scene is `?` and the reason says why.

    Raises:
        OSError: The folder can't be read; it may be missing.
    """
    failed = {}
    for name in list_names(variants):
        if not name.startswith(FAILED_PREFIX):
            continue
        try:
            why = read_failure(variants / name)
        except StoreError as error:
            why = "?", str(error)
        failed[name.removeprefix(FAILED_PREFIX)] = why
    return failed
