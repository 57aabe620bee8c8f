"""Removes the heavy files of variants, keeps each view's texture, and makes the images again.

A trimmed variant keeps its list of views, cameras, points, SfM report and the texture of each view,
in the folder `variants/trimmed-<id>`. Its cells are still found and reported. Before a new cell is
trained on it, its photographs are resized, degraded and undistorted as when the variant was built:
the same photographs and libraries give the same bytes, and the variant's hashes verify them. SfM is
not run again: on another machine it may place the cameras otherwise. (`CellFolder.trim` is for
cells.)

Texture is the mean magnitude of a photograph's gradient, which `xrgs.training.components.weighting`
defines. Section 7.2 of the paper finds XR-GS better on textured scenes and the baseline better on
simple ones, and does not say how texture is measured [xrgs, section 7].
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from xrgs.config import SceneConf, VariantConf
from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.mixture import poses, saved_variant
from xrgs.mixture.paths import id_of, is_trimmed, trimmed_folder
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.photos import images, scenes
from xrgs.photos.images import ImageError
from xrgs.photos.lens import Lens
from xrgs.runtime import lease
from xrgs.runtime.progress import progress
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json
from xrgs.safeio.files import file_bytes, remove_path, sync_name, sync_tree
from xrgs.safeio.records import list_folder, read_struct

_IMAGES = "images"
#: The file of a trimmed variant with the texture of each view, by its split and name: `test/a`.
TEXTURES = "textures.json"


def home_of(variants: Path, variant_id: str) -> Path:
    """Return the folder of a variant, which is trimmed or not, or is not there."""
    trimmed = trimmed_folder(variants, variant_id)
    return trimmed if trimmed.is_dir() else variants / variant_id


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
    if (trimmed / _IMAGES).is_dir() and not (trimmed / TEXTURES).exists():
        write_json(trimmed / TEXTURES, textures(trimmed))
    remove_path(trimmed / _IMAGES)


def image_bytes(variants: Path, variant_id: str) -> int:
    """Return the bytes of a variant's images, which trimming it would free."""
    folder = home_of(variants, variant_id) / _IMAGES
    return file_bytes(folder) if folder.is_dir() else 0


def verify_variant(folder: Path) -> list[str]:
    """Return a line for each file of a trimmed variant that is missing, changed or unreadable."""
    try:
        content = saved_variant.read_manifest(folder)
    except StoreError as error:
        return [str(error)]
    kept = {saved_variant.POINTS: content.files[saved_variant.POINTS]}
    return list(map(str, checksums.changed(folder, kept)))


# Texture


def texture(image: NDArray[np.float32], mask: NDArray[np.bool_] | None = None) -> float:
    """Return the mean magnitude of an image's gradient, in intensity per px; NaN for no pixel.

    It is `mean_gradient` of `xrgs.training.components.weighting`, always without the last row and
    column, which repeat others there. That function needs torch; this one does not. The image is
    [H, W, 3] in 0..1, and a mask [H, W] is True for a pixel that is used.
    """
    if min(image.shape[:2]) < 2:
        return math.nan
    inner = image[:-1, :-1].astype(np.float64)
    squared = (image[:-1, 1:] - inner) ** 2 + (image[1:, :-1] - inner) ** 2
    magnitude = np.sqrt(squared.mean(axis=2))
    if mask is not None:
        magnitude = magnitude[mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]]
    return float(magnitude.mean()) if magnitude.size else math.nan


def textures(folder: Path, views: Sequence[str] | None = None) -> dict[str, float]:
    """Return the textures of a variant's views, by names such as `test/a`, that can be read.

    Of a trimmed variant they are those that were kept; else those of `views`, None for all.
    """
    if (folder / TEXTURES).exists():
        return read_struct(folder / TEXTURES, dict[str, float])
    if views is None:
        files = (file for s in ("test", "train") for file in (folder / _IMAGES / s).glob("*.png"))
        views = sorted(f"{file.parent.name}/{file.stem}" for file in files)
    measured: dict[str, float] = {}
    for view in views:
        split, _, name = view.partition("/")
        mask = folder / _IMAGES / f"{split}-masks" / f"{name}.png"
        try:
            image = images.read_png(folder / _IMAGES / f"{view}.png")
            size = image.shape[1], image.shape[0]
            used = images.read_mask(mask, size) if mask.exists() else None
        except (ImageError, StoreError):
            continue
        if not math.isnan(value := texture(image, used)):
            measured[view] = value
    return measured


# Making the images again


class _Camera(Struct):
    """A camera, and the names of the photographs that have it."""

    lens: Lens
    views: list[str]


class _Report(Struct):
    """The part of `report.json` that is read here."""

    lenses: list[_Camera]


def restore_variant(
    variants: Path, variant_id: str, scene: SceneConf, conf: VariantConf, cache: Path
) -> None:
    """Make the images of a trimmed variant again; any number of processes may call this at once.

    Nothing happens to a variant that has its images. Arguments as for `restore_images`.

    Raises:
        UnreadableError: A photograph can't be read now.
        StoreError: The images can't be made again; the message says why. The variant stays trimmed.
    """
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
        remove_path(folder / TEXTURES)  # it can be measured again
        sync_tree(folder)
        folder.rename(variants / variant_id)
        sync_name(variants / variant_id)


def restore_images(
    folder: Path, scene: SceneConf, conf: VariantConf, work: Path, cache: Path
) -> None:
    """Make the images of a variant, and compare them with the hashes in its list of files.

    The configs are those that it was built with, `work` is a folder for temporary files, and
    `cache` the store's folder of rendered scenes.

    Raises:
        XrgsError: The photographs can't be read, a file of the folder is damaged or names no
            photograph, or an image differs from the removed one; the message names it.
    """
    manifest = saved_variant.read_manifest(folder)
    cameras = read_struct(folder / saved_variant.REPORT, _Report).lenses
    lenses = {name: camera.lens for camera in cameras for name in camera.views}
    photographed = poses.with_masks(scenes.resolve(scene, cache, conf.long_side), conf.poses)
    photos = prepare_hr_views(photographed, conf, work)
    _write_images(folder, manifest.views, photos, lenses, conf)
    for error in checksums.changed(folder, manifest.files):
        raise StoreError(
            f"{error}: made again from the photographs it is another image, as other versions of"
            " the libraries that read and resize photographs may give"
        )


def _write_images(
    folder: Path,
    entries: Sequence[saved_variant.ViewEntry],
    photos: PhotoCollection,
    lenses: Mapping[str, Lens],
    conf: VariantConf,
) -> None:
    (folder / _IMAGES).mkdir()
    numbers = {name: number for number, name in enumerate(photos.names)}
    if missing := {entry.name for entry in entries} - numbers.keys():
        raise StoreError(f"{folder}: the photograph of its view {min(missing)} is missing")
    # A view that was degraded has two entries; one is its original.
    degraded = {numbers[entry.name] for entry in entries if entry.split == "original"}
    write_degraded(photos, sorted(degraded), conf)
    for entry in progress(entries, "undistorting", "view"):
        number = numbers[entry.name]
        if entry.name not in lenses:
            file = folder / saved_variant.REPORT
            raise StoreError(f"damaged: {file}: lenses: none is of view {entry.name}")
        kind = "lr" if entry.split == "train" and number in degraded else "hr"
        lens = lenses[entry.name].resized(*photos.size(kind, number))
        image, used = photos.undistorted(kind, number, lens)
        images.save(folder / entry.file, image, durable=False)
        if used is not None and entry.mask is not None:
            images.save_mask(folder / entry.mask, used, durable=False)
