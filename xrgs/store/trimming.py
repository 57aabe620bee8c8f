"""Removes the heavy files of done cells and of variants, and lists the removed files.

A trimmed cell stays done: the files that tables are made of stay, and its `status.json` lists the
removed files with their sizes and hashes. A trimmed variant keeps its list of views, cameras,
points, SfM report and the texture of each view, in the folder `variants/trimmed-<id>`. Its cells
are still found and reported. Before a new cell is trained on it, its images are made again from the
photographs. SfM is not run again: on another machine it may place the cameras otherwise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.mixture import saved_variant
from xrgs.mixture.paths import id_of, is_trimmed, trimmed_folder
from xrgs.runtime import lease
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import file_bytes, remove_path, sync_name, sync_tree
from xrgs.safeio.records import list_folder
from xrgs.store import texture

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.config import SceneConf, VariantConf

_IMAGES = "images"


def trimmed_variant(variants: Path, key: str) -> str | None:
    """Return the id of the trimmed variant with a key (`xrgs.mixture.variant.key`), or None."""
    ids = map(id_of, filter(is_trimmed, list_folder(variants)))
    return next((variant_id for variant_id in ids if variant_id.startswith(f"{key}-")), None)


def check_images(variants: Path, variant_id: str) -> None:
    """Raise `StoreError` where a variant is trimmed; the message says what makes its images."""
    if trimmed_folder(variants, variant_id).is_dir():
        raise StoreError(
            f"variant {variant_id}: its images were removed by xrgs-store trim; xrgs-sweep makes"
            " them again when it trains a cell on this variant"
        )


def trim_variant(variants: Path, variant_id: str) -> None:
    """Remove the images of a variant, and mark it as trimmed by the name of its folder.

    Trimming a trimmed variant completes a removal that was stopped, and else changes nothing.
    """
    folder, trimmed = variants / variant_id, trimmed_folder(variants, variant_id)
    if folder.is_dir():
        folder.rename(trimmed)
        sync_name(trimmed)
    if (trimmed / _IMAGES).is_dir() and not (trimmed / texture.FILE).exists():
        write_json(trimmed / texture.FILE, texture.textures(trimmed))
    remove_path(trimmed / _IMAGES)


def restore_variant(
    variants: Path, variant_id: str, scene: SceneConf, conf: VariantConf, cache: Path
) -> None:
    """Make the images of a trimmed variant again; any number of processes may call this at once.

    Nothing happens to a variant that has its images. Arguments as for `restore_images`.

    Raises:
        UnreadableError: A photograph can't be read now.
        StoreError: The images can't be made again; the message says why. The variant stays trimmed.
    """
    from xrgs.store.restore import restore_images

    folder, key = trimmed_folder(variants, variant_id), variant_id.rpartition("-")[0]
    with lease.waited_for(variants, f".{key}.lock"):
        if not folder.is_dir():
            return
        work = variants / f".{variant_id}.restoring"
        # A killed process may have left both.
        remove_path(work)
        remove_path(folder / _IMAGES)
        work.mkdir()
        try:
            restore_images(folder, scene, conf, work, cache)
        except XrgsError as error:
            remove_path(folder / _IMAGES)
            if isinstance(error, UnreadableError):
                raise
            raise StoreError(
                f"variant {variant_id}: its images were removed by xrgs-store trim, and can't be"
                f" made again: {error}. Remove {folder} to let another variant be built, on which"
                " all cells of the comparison are trained anew; the reports of the old ones stay"
            ) from error
        finally:
            remove_path(work)
        remove_path(folder / texture.FILE)  # it can be measured again
        sync_tree(folder)
        folder.rename(variants / variant_id)
        sync_name(variants / variant_id)


def image_bytes(variants: Path, variant_id: str) -> int:
    """Return the bytes of a variant's images, which trimming it would free."""
    homes = (variants / variant_id, trimmed_folder(variants, variant_id))
    images = [home / _IMAGES for home in homes if (home / _IMAGES).is_dir()]
    return sum(map(file_bytes, images))


def verify_variant(folder: Path) -> list[str]:
    """Return a line for each file of a trimmed variant that is missing, changed or unreadable."""
    try:
        content = saved_variant.read_manifest(folder)
    except StoreError as error:
        return [str(error)]
    kept = {saved_variant.POINTS: content.files[saved_variant.POINTS]}
    return list(map(str, checksums.changed(folder, kept)))
