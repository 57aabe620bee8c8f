"""Removes the heavy files of done cells and of variants on purpose, and tells that they were.

A trimmed cell stays done: everything that tables are made of is kept, and its `status.json` lists
what was removed, with sizes and hashes. A trimmed variant keeps its list of views, cameras, points
and SfM report, in the folder `variants/trimmed-<id>`. Its cells are still found and reported. A new
cell can't be trained on it, because its images are gone and another SfM would give another variant.
"""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

from xrgs.capture import frozen, sealed
from xrgs.errors import StoreError
from xrgs.safeio.records import errors_named, read_object

if TYPE_CHECKING:
    from xrgs.safeio.confined import ConfinedPath

#: The beginning of the name of a trimmed variant's folder; the variant's id follows.
TRIMMED_PREFIX = "trimmed-"
_IMAGES = "images"


def trimmed_folder(variants: ConfinedPath, variant_id: str) -> ConfinedPath:
    """Return the folder that a variant has when it is trimmed; it need not exist.

    Args:
        variants: The store's folder of variants.
        variant_id: The variant's id, a valid name of a folder.
    """
    return variants / f"{TRIMMED_PREFIX}{variant_id}"


def trimmed_variant(variants: ConfinedPath, key: str) -> str | None:
    """Return the id of the trimmed variant of a key; None where there is none.

    Args:
        variants: The store's folder of variants.
        key: What `xrgs.capture.variant.key` gives.

    Raises:
        StoreError: The folder of variants can't be listed.
    """
    start = f"{TRIMMED_PREFIX}{key}-"
    with errors_named(variants):
        try:
            names = [name for name in variants.names() if name.startswith(start)]
        except FileNotFoundError:  # of the folder, or of a store that is not there yet
            return None
    return names[0].removeprefix(TRIMMED_PREFIX) if names else None


def check_images(variants: ConfinedPath, variant_id: str) -> None:
    """Refuse a variant whose images were removed on purpose.

    Args:
        variants: The store's folder of variants.
        variant_id: The variant's id.

    Raises:
        StoreError: It is trimmed; the message says what can be done.
    """
    folder = trimmed_folder(variants, variant_id)
    if folder.is_dir():
        raise StoreError(
            f"variant {variant_id}: its images were removed by xrgs-store trim, so that no cell can"
            f" be trained on it. Remove {folder} to let another variant be built, on which all"
            " cells of the comparison are trained anew; the reports of the old ones stay"
        )


def trim_variant(variants: ConfinedPath, variant_id: str) -> None:
    """Remove the images of a variant, and mark it as trimmed by the name of its folder.

    Nothing happens to a variant that is trimmed already, except that a removal that was stopped
    midway is completed.

    Args:
        variants: The store's folder of variants.
        variant_id: The variant's id.

    Raises:
        OSError: It can't be renamed, or its images can't be removed.
    """
    folder, trimmed = variants / variant_id, trimmed_folder(variants, variant_id)
    if folder.is_dir():
        folder.rename(trimmed)
        trimmed.sync_name()
    (trimmed / _IMAGES).remove()


def image_bytes(variants: ConfinedPath, variant_id: str) -> int:
    """Return the bytes of a variant's images, which trimming it would free.

    Args:
        variants: The store's folder of variants.
        variant_id: The variant's id.
    """
    homes = (variants / variant_id, trimmed_folder(variants, variant_id))
    images = [home / _IMAGES for home in homes if (home / _IMAGES).is_dir()]
    found = [status for folder in images for _, status in folder.walk()]
    return sum(status.st_size for status in found if stat.S_ISREG(status.st_mode))


def verify_variant(folder: ConfinedPath) -> list[str]:
    """Say what is wrong with what a trimmed variant has kept.

    Args:
        folder: Its folder.

    Returns:
        A line for each file that is missing, has changed or can't be read now.
    """
    manifest = folder / frozen.MANIFEST
    try:
        content = read_object(manifest)
        same = frozen.variant_id(content) == folder.name.removeprefix(TRIMMED_PREFIX)
        kept = {frozen.POINTS: content["files"][frozen.POINTS]}
    except StoreError as error:
        return [str(error)]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        return [f"{manifest}: not a complete variant ({error!r:.200})"]
    wrong = [] if same else [f"{manifest}: it has changed since it was written"]
    return [*wrong, *map(str, sealed.changed(folder, kept))]
