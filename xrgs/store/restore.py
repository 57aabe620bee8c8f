"""Makes the images of a variant again, which `xrgs-store trim` has removed.

The variant's folder keeps the results of SfM: camera poses, points and the lens of every
photograph. The photographs are resized, degraded and undistorted as when the variant was built, so
that the same photographs and libraries give the same bytes. The variant's hashes verify them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from xrgs.errors import StoreError
from xrgs.mixture import poses, saved_variant
from xrgs.mixture.photographs import prepare_hr_views, write_degraded
from xrgs.photos import images, scenes
from xrgs.photos.lens import Lens
from xrgs.runtime.progress import progress
from xrgs.safeio import checksums
from xrgs.safeio.records import read_struct

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from xrgs.config import SceneConf, VariantConf
    from xrgs.mixture.photographs import PhotoCollection


class _Camera(Struct):
    """A camera, and the names of the photographs that have it."""

    lens: Lens
    views: list[str]


class _Report(Struct):
    """The part of `report.json` that is read here."""

    lenses: list[_Camera]


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
    (folder / "images").mkdir()
    numbers = {name: number for number, name in enumerate(photos.names)}
    if missing := {entry.name for entry in entries} - numbers.keys():
        raise StoreError(f"{folder}: the photograph of its view {min(missing)} is missing")
    # A view that was degraded has two entries; one is its original.
    degraded = {numbers[entry.name] for entry in entries if entry.split == "original"}
    write_degraded(photos, sorted(degraded), conf)
    for entry in progress(entries, "undistorting", "view"):
        number = numbers[entry.name]
        is_low = entry.split == "train" and number in degraded
        if entry.name not in lenses:
            file = folder / saved_variant.REPORT
            raise StoreError(f"damaged: {file}: lenses: none is of view {entry.name}")
        kind = "lr" if is_low else "hr"
        lens = lenses[entry.name].resized(*photos.size(kind, number))
        image, used = photos.undistorted(kind, number, lens)
        images.save(folder / entry.file, image, durable=False)
        if used is not None and entry.mask is not None:
            images.save_mask(folder / entry.mask, used, durable=False)
