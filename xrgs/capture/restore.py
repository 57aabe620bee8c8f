"""Makes the images of a variant again, which `xrgs-store trim` has removed.

What SfM found is kept in the variant's folder: camera poses, points and the lens of every
photograph. The photographs are resized, degraded and undistorted as when the variant was built, so
that the same photographs and libraries give the same bytes, which the variant's hashes verify.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture import frozen, images, scenes, sealed
from xrgs.capture.lens import Lens, undistort
from xrgs.capture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.errors import StoreError
from xrgs.runtime.progress import progress
from xrgs.safeio.records import read_struct

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from xrgs.config import SceneConf, VariantConf

#: A field of a lens in `report.json`, where each lens is written as `Lens(width=500, ..., k=0.01)`.
_FIELD = re.compile(r"(\w+)=([^,()]+)")


def restore_images(
    folder: Path,
    scene: SceneConf,
    conf: VariantConf,
    work: Path,
    cache: Path,
) -> None:
    """Make the images of a variant, and verify them by its hashes.

    Args:
        folder: The variant's folder, which has all of its files but the images.
        scene: The config of its scene.
        conf: The config that it was built with.
        work: An existing folder for temporary files.
        cache: The store's folder of rendered scenes.

    Raises:
        StoreError: What the folder says of the views does not fit the photographs, or the images
            are not those that were removed; the message names the first that differs.
        XrgsError: The photographs can't be read.
    """
    manifest = frozen.read_manifest(folder)
    found = scenes.resolve(scene, cache, conf.long_side)
    photos = prepare_hr_views(found, conf, work)
    try:
        lenses = _lenses(read_struct(folder / frozen.REPORT, dict[str, Any]))
        _write_images(folder, manifest.views, photos, lenses, conf)
    except (AttributeError, KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise StoreError(f"{folder}: not a complete variant ({error!r:.200})") from error
    for wrong in sealed.changed(folder, manifest.files):
        raise StoreError(
            f"{wrong}: made again from the photographs it is another image, as other versions of"
            " the libraries that read and resize photographs may give"
        )


def _write_images(
    folder: Path,
    entries: Sequence[frozen.ViewEntry],
    photos: PhotoCollection,
    lenses: Sequence[Lens],
    conf: VariantConf,
) -> None:
    """Write the image of each view of a variant."""
    (folder / "images").mkdir()
    numbers = {name: number for number, name in enumerate(photos.names)}
    # Each view that was degraded is also there as it was before.
    degraded = {numbers[entry.name] for entry in entries if entry.split == "original"}
    write_degraded(photos, sorted(degraded), conf)
    by_size: dict[tuple[int, int], dict[bytes, Lens]] = {}
    for entry in progress(entries, "undistorting", "view"):
        number, part = numbers[entry.name], entry.split
        copies = {"train": "lr" if number in degraded else "hr", "test": "hr", "original": "hr"}
        image = photos.read(copies[part], number)
        size = image.shape[1], image.shape[0]
        if size not in by_size:
            by_size[size] = _by_intrinsics([lens.resized(*size) for lens in lenses])
        lens = by_size[size].get(np.array(entry.K, dtype=np.float64).tobytes())
        if lens is None:
            raise ValueError(f"{frozen.REPORT} has no lens of view {photos.names[number]}")
        file = folder / "images" / part / f"{photos.names[number]}.png"
        images.save(file, undistort(image, lens), durable=False)


def _by_intrinsics(lenses: Sequence[Lens]) -> dict[bytes, Lens]:
    """Return lenses by the intrinsics of their undistorted images, which a variant's views have."""
    return {lens.undistorted().K.tobytes(): lens for lens in lenses}


def _lenses(report: Mapping[str, Any]) -> list[Lens]:
    """Read the lenses of the photographs from the report of SfM."""
    return [Lens(**dict(_fields(text))) for text in report["lenses"]]


def _fields(text: str) -> Iterator[tuple[str, Any]]:
    for name, value in _FIELD.findall(text):
        yield name, int(value) if name in {"width", "height"} else float(value)
