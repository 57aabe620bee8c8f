"""The folders in a store's `variants/`, by their names, and the reports of failed scenes.

- `<key>-<hash>`: a frozen variant, named by its id, see `xrgs.mixture.saved_variant`.
- `trimmed-<id>`: a variant without its images, see `xrgs.store.trimming`.
- `failed-<key>`: a scene for which no variant could be made. `report.json` has the results of SfM
  and the reason, and `colmap.log` is COLMAP's log.
- Names with a leading dot: work in progress, a lease, or a damaged folder that was set aside.
"""

from __future__ import annotations

from pathlib import Path

from msgspec import Struct

from xrgs.errors import StoreError
from xrgs.safeio.files import is_name, list_names
from xrgs.safeio.records import read_struct

_FAILED, _TRIMMED = "failed-", "trimmed-"
#: Advice if SfM places too few photographs of a scene. Using all pixels is first, since it costs
#: only time; accepting fewer views is last.
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
    """Return whether a folder with this name is a variant, trimmed or not."""
    return "-" in name and not name.startswith((".", _FAILED)) and is_name(name)


def is_trimmed(name: str) -> bool:
    """Return whether a folder with this name is a trimmed variant."""
    return name.startswith(_TRIMMED)


def is_failed(name: str) -> bool:
    """Return whether a folder with this name is the report of a failed scene."""
    return name.startswith(_FAILED)


def id_of(name: str) -> str:
    """Return the variant's id from the name of its folder, trimmed or not."""
    return name.removeprefix(_TRIMMED)


def trimmed_folder(variants: Path, variant_id: str) -> Path:
    """Return the folder of a variant after trimming. It may not exist."""
    return variants / f"{_TRIMMED}{variant_id}"


def failed_folder(variants: Path, key: str) -> Path:
    """Return the folder for the SfM report of a variant that failed. It may not exist."""
    return variants / f"{_FAILED}{key}"


class _FailureReport(Struct):
    """The fields of a failed scene's `report.json` that this module reads."""

    scene: str
    reason: str


def read_failure(folder: Path) -> tuple[str, str]:
    """Read the name of a failed scene, and the reason; StoreError if the report is damaged."""
    report = read_struct(folder / "report.json", _FailureReport)
    return report.scene, report.reason


def failed_scenes(variants: Path) -> dict[str, tuple[str, str]]:
    """List the failed scenes: key of the variant -> name of the scene, and the reason.

    If a report can't be read, the name is `?` and the reason is the error. If the folder is missing
    or can't be read, OSError is raised.
    """
    failed = {}
    for name in filter(is_failed, list_names(variants)):
        try:
            why = read_failure(variants / name)
        except StoreError as error:
            why = "?", str(error)
        failed[name.removeprefix(_FAILED)] = why
    return failed
