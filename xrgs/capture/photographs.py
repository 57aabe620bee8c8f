"""Turns a scene's photographs into HR views on disk, and decides which of them share a camera."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from xrgs.capture import images
from xrgs.capture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.capture.lens import Lens, lens_of_model
from xrgs.capture.split import HrGeometry, hr_geometry, shrink_factor
from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from xrgs.capture.scenes import Scene
    from xrgs.config import VariantConf

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photograph:
    """One readable photograph of a scene."""

    name: str
    """The name that its view gets."""
    number: str
    """The name of its copies on disk, because COLMAP need not accept people's file names."""
    size: tuple[int, int]
    """Width and height of the file, with the EXIF orientation applied, px."""
    hr: HrGeometry
    """The size of its HR view."""
    camera: str
    """The name of its camera; photographs with one name share the camera in SfM."""
    K: NDArray[np.float64] | None
    """Intrinsics [3, 3] of the file, px, where they are known; then there is no distortion."""
    path: Path
    """The file."""

    @property
    def lens(self) -> Lens | None:
        """The camera of the HR view, after resize and crop; None where it is not known."""
        if self.K is None:
            return None
        K = self.K
        params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        return self.to_hr(lens_of_model("PINHOLE", self.size, params))

    def to_hr(self, lens: Lens) -> Lens:
        """Return the camera of the HR view; `lens` is of the whole photograph, at any size."""
        return lens.resized(*self.hr.resized).cropped(
            *self.hr.crop_offset, self.hr.width, self.hr.height
        )


@dataclass(frozen=True)
class PhotoCollection:
    """The readable photographs of a scene, sorted by name, and their copies in a work folder.

    A copy is of one of three kinds: `hr` is the HR view, `lr` the degraded view, and `up` the
    degraded view resized back to the size of the HR view, for SfM.
    """

    all: tuple[Photograph, ...]
    folder: Path
    unreadable: tuple[str, ...] = ()
    """One message for each photograph that was left out."""

    def __len__(self) -> int:
        return len(self.all)

    def __getitem__(self, index: int) -> Photograph:
        return self.all[index]

    @property
    def names(self) -> list[str]:
        """The names of the photographs, in order."""
        return [photo.name for photo in self.all]

    def file(self, kind: str, index: int) -> str:
        """Return the path of a copy (`hr`, `lr` or `up`) in `folder`; the copy need not exist."""
        return f"{kind}/{self.all[index].number}.png"

    def size(self, kind: str, index: int) -> tuple[int, int]:
        """Return width and height of an existing copy, px."""
        return images.size(self.folder / self.file(kind, index))

    def read(self, kind: str, index: int) -> images.ImageArray:
        """Read an existing copy, [H, W, 3] in 0..1."""
        return images.read(self.folder / self.file(kind, index))

    def upsample(self, index: int) -> None:
        """Make the `up` copy of a photograph from its `lr` copy, where it does not exist."""
        file = self.folder / self.file("up", index)
        if not file.exists():
            target = self.all[index].hr
            up = images.resize(self.read("lr", index), target.width, target.height)
            images.save(file, up, durable=False)


def prepare_hr_views(scene: Scene, conf: VariantConf, work: Path) -> PhotoCollection:
    """Read every photograph, leave out the unreadable ones, and write the others as HR views.

    All are resized by one factor, so that a camera that resolved more than another still does.

    Args:
        scene: The scene.
        conf: The variant's config.
        work: An existing folder for the copies.

    Raises:
        UnreadableError: A photograph can't be read now. It is not left out: the variant would be
            another one whenever a disk or a server fails.
        XrgsError: Fewer than two photographs can be read, or a photograph is too small for its LR
            view or too large for a variant; the message names the photographs.
    """
    sizes, unreadable = _read_sizes(scene.files)
    shrink = shrink_factor(list(sizes.values()), conf) if sizes else 1.0
    geometries: dict[str, HrGeometry] = {}
    for name, size in progress(sizes.items(), "HR views", "view"):
        file = scene.files[name]
        try:
            image = images.read(file)
        except images.ImageError as error:
            unreadable[name] = str(error)
            continue
        try:
            geometries[name] = hr = _checked_geometry(size, shrink, conf)
        except XrgsError as error:
            raise XrgsError(f"{file}: {error}") from None
        copy = work / "hr" / f"{len(geometries) - 1:05d}.png"
        images.save(copy, _resize_and_crop(image, hr), durable=False)
    messages = tuple(unreadable[name] for name in scene.files if name in unreadable)
    for message in messages:
        _log.warning("%s; left out", message)
    if len(geometries) < 2:
        count = f"{len(geometries)} readable image(s), two are needed"
        raise XrgsError(f"scene {scene.name}: {count}: {list(messages)}")
    files = [scene.files[name] for name in geometries]
    cameras = assign_cameras(files, [sizes[name] for name in geometries], conf.sfm.camera)
    photos = (
        Photograph(name, f"{i:05d}", sizes[name], hr, camera, scene.intrinsics.get(name), path)
        for i, ((name, hr), camera, path) in enumerate(
            zip(geometries.items(), cameras, files, strict=True)
        )
    )
    return PhotoCollection(tuple(photos), work, messages)


def _checked_geometry(size: tuple[int, int], shrink: float, conf: VariantConf) -> HrGeometry:
    hr = hr_geometry(size, shrink, conf)
    if hr.width * hr.height > images.MAX_PNG_PIXELS:
        raise XrgsError(
            f"an HR view of {hr.width}x{hr.height} px has more than {images.MAX_PNG_PIXELS} "
            f"pixels; lower variant.long_side={conf.long_side}"
        )
    return hr


def _resize_and_crop(image: images.ImageArray, hr: HrGeometry) -> images.ImageArray:
    left, top = hr.crop_offset
    return images.resize(image, *hr.resized)[top : top + hr.height, left : left + hr.width]


def _read_sizes(
    files: Mapping[str, Path],
) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    """Read the size of each file, or the message that says why it has none, by its name."""
    sizes: dict[str, tuple[int, int]] = {}
    unreadable: dict[str, str] = {}
    for name, file in files.items():
        try:
            sizes[name] = images.size(file)
        except images.ImageError as error:
            unreadable[name] = str(error)
    return sizes, unreadable


def assign_cameras(
    files: Sequence[Path], sizes: Sequence[tuple[int, int]], policy: str
) -> list[str]:
    """Name the camera of each photograph; photographs with one name share it in SfM.

    Args:
        files: The photographs.
        sizes: Their width and height with the EXIF orientation applied, px: a camera held upright
            is another camera to SfM. All photographs with one name have one size.
        policy: `variant.sfm.camera`: `single` for one camera, `per_image` for one each, `auto` for
            one per size and EXIF camera.

    Raises:
        XrgsError: The policy is `single`, but the sizes differ.
    """
    one_size = len(set(sizes)) == 1
    if policy == "single":
        if not one_size:
            other = next(i for i, size in enumerate(sizes) if size != sizes[0])
            a, b = (f"{files[i]} is {sizes[i][0]}x{sizes[i][1]}" for i in (0, other))
            raise XrgsError(
                f"variant.sfm.camera=single, but sizes differ: {a}, {b}; use auto or per_image"
            )
        return ["all"] * len(files)
    if policy == "per_image":
        return [f"{i:05d}" for i in range(len(files))]
    names = []
    for i, (file, size) in enumerate(zip(files, sizes, strict=True)):
        exif = images.exif_camera(file)
        # Where EXIF names no camera and the sizes differ, two equal sizes are a coincidence.
        own = not exif and not one_size
        names.append(f"{i:05d}" if own else f"{size[0]}x{size[1]} {exif}")
    return names


def write_degraded(photos: PhotoCollection, which: Sequence[int], conf: VariantConf) -> None:
    """Degrade the HR views of these indices, and write them as `lr` copies."""
    if not which:
        return
    degrade = DEGRADATIONS[resolve_degradation(conf)]
    for i in progress(which, "LR views", "view"):
        low = degrade(photos.read("hr", i), conf)
        images.save(photos.folder / photos.file("lr", i), low, durable=False)
