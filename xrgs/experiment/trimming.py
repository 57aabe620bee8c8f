"""Removes the heavy files of done cells and of variants on purpose, and tells that they were.

A trimmed cell stays done: everything that tables are made of is kept, and its `status.json` lists
what was removed, with sizes and hashes. A trimmed variant keeps its list of views, cameras, points
and SfM report, in the folder `variants/trimmed-<id>`. Its cells are still found and reported.
Before a new cell is trained on it, its images are made again from the photographs: another SfM
would give another variant.
"""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

from xrgs.capture import frozen, sealed
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.safeio.records import errors_named, read_object

if TYPE_CHECKING:
    from xrgs.config import SceneConf, VariantConf
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
            f"variant {variant_id}: its images were removed by xrgs-store trim; xrgs-sweep makes"
            " them again when it trains a cell on this variant"
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


def restore_variant(
    variants: ConfinedPath,
    variant_id: str,
    scene: SceneConf,
    conf: VariantConf,
    cache: ConfinedPath,
) -> None:
    """Make the images of a trimmed variant again; any number of processes may call this at once.

    Nothing happens to a variant that has its images.

    Args:
        variants: The store's folder of variants.
        variant_id: The variant's id.
        scene: The config of its scene.
        conf: The config that it was built with.
        cache: The store's folder of rendered scenes.

    Raises:
        UnreadableError: A photograph can't be read now.
        StoreError: The images can't be made again; the message says why. The variant stays trimmed.
        OSError: The store can't be written.
    """
    from xrgs.capture.restore import restore_images

    folder, key = trimmed_folder(variants, variant_id), variant_id.rpartition("-")[0]
    with sealed.lock(variants / f".{key}.lock"):
        if not folder.is_dir():
            return
        work = variants / f".{variant_id}.restoring"
        work.remove()  # what a killed process left, as in the variant's own folder
        (folder / _IMAGES).remove()
        work.make_folder()
        try:
            restore_images(folder, scene, conf, work, cache)
        except XrgsError as error:
            (folder / _IMAGES).remove()
            if isinstance(error, UnreadableError):
                raise
            raise StoreError(
                f"variant {variant_id}: its images were removed by xrgs-store trim, and can't be"
                f" made again: {error}. Remove {folder} to let another variant be built, on which"
                " all cells of the comparison are trained anew; the reports of the old ones stay"
            ) from error
        finally:
            work.remove()
        folder.sync_tree()
        folder.rename(variants / variant_id)
        (variants / variant_id).sync_name()


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
