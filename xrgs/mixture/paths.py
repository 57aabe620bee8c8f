"""The folders in a store's `variants/`: what their names mean, and the reports of failed scenes.

- `<key>-<hash>` is a frozen variant, named by its id, see `xrgs.mixture.saved_variant`.
- `trimmed-<id>` is a variant without its images, see `xrgs.store.trimming`.
- `failed-<key>` is of a scene that could not be made into a variant: `report.json` says how SfM
  went and why the scene failed, and `colmap.log` is COLMAP's log.
- A name with a dot at its beginning is of work in progress, a lease, or a damaged folder that was
  set aside.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from xrgs.errors import StoreError
from xrgs.safeio.files import is_name, list_names
from xrgs.safeio.records import read_struct

if TYPE_CHECKING:
    from pathlib import Path

_FAILED, _TRIMMED = "failed-", "trimmed-"
#: What to try where SfM places too few photographs of a scene. The photographs' own pixels come
#: first, since they cost nothing but time; fewer views come last.
TO_TRY = (
    'What to try where too few photographs are placed, in this order ("When a scene fails" in'
    " docs/your_photographs.md):",
    "1. variant.sfm.long_side=0: COLMAP gets all pixels of the photographs",
    "2. variant.sfm.max_num_features=16384: more features in each of them",
    "3. a smaller variant.factor or a larger variant.hr_fraction: LR photographs keep more detail",
    "4. other photographs: without those of another place or time, with more between the others",
    "5. variant.poses=PATH: cameras that COLMAP or another program has found",
    "6. variant.sfm.min_registered=0.5: go on with half of the photographs",
)


def is_variant(name: str) -> bool:
    """Return whether a name is of a variant's folder, trimmed or not."""
    return "-" in name and not name.startswith((".", _FAILED)) and is_name(name)


def is_trimmed(name: str) -> bool:
    """Return whether a name is of a trimmed variant's folder."""
    return name.startswith(_TRIMMED)


def is_failed(name: str) -> bool:
    """Return whether a name is of a failed scene's folder."""
    return name.startswith(_FAILED)


def id_of(name: str) -> str:
    """Return the id of the variant whose folder has this name, trimmed or not."""
    return name.removeprefix(_TRIMMED)


def trimmed_folder(variants: Path, variant_id: str) -> Path:
    """Return the folder that a variant has when it is trimmed; it need not exist."""
    return variants / f"{_TRIMMED}{variant_id}"


def failed_folder(variants: Path, key: str) -> Path:
    """Return the folder for the report where the scene of a key fails; it need not exist."""
    return variants / f"{_FAILED}{key}"


class _FailureReport(Struct):
    """The part of a failed scene's `report.json` that is read here."""

    scene: str
    reason: str


def read_failure(folder: Path) -> tuple[str, str]:
    """Return which scene could not be made into a variant, and why.

    Raises:
        UnreadableError: The report in the folder can't be read now.
        StoreError: The report is missing or damaged.
    """
    report = read_struct(folder / "report.json", _FailureReport)
    return report.scene, report.reason


def failed_scenes(variants: Path) -> dict[str, tuple[str, str]]:
    """List the scenes that could not be made into a variant.

    Returns:
        The scene's name and the reason, by the key of the variant. Where the report can't be read,
        the scene is `?` and the reason says why.

    Raises:
        OSError: The folder can't be read; it may be missing.
    """
    failed = {}
    for name in filter(is_failed, list_names(variants)):
        try:
            why = read_failure(variants / name)
        except StoreError as error:
            why = "?", str(error)
        failed[name.removeprefix(_FAILED)] = why
    return failed
