"""A scene's photographs as HR views on disk: each of its own size, and which share a camera."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from xrgs.capture import degrade, images
from xrgs.capture.images import Lens
from xrgs.capture.split import Frame, frame, scale
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
    """Its file name without the ending."""
    number: str
    """Names its copies, for COLMAP need not cope with people's file names."""
    size: tuple[int, int]
    """Width and height of the file, upright, px."""
    frame: Frame
    camera: str
    """Photographs of one value share one camera."""
    K: NDArray[np.float64] | None
    """[3, 3] px of the file, where known: then it has no distortion."""

    @property
    def lens(self) -> Lens | None:
        """The camera of the HR view, where known: the file's, resized, then cropped."""
        if self.K is None:
            return None
        K, (left, top) = self.K, self.frame.corner
        lens = Lens(*self.size, K[0, 0], K[1, 1], K[0, 2], K[1, 2]).at(*self.frame.resized)
        cx, cy = lens.cx - left, lens.cy - top
        return Lens(self.frame.width, self.frame.height, lens.fx, lens.fy, cx, cy)


@dataclass(frozen=True)
class Photographs:
    """All of a scene, sorted by name; their copies lie in `folder`."""

    all: tuple[Photograph, ...]
    folder: Path
    unreadable: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.all)

    def __getitem__(self, index: int) -> Photograph:
        return self.all[index]

    @property
    def names(self) -> list[str]:
        """Of the photographs, in order."""
        return [photo.name for photo in self.all]

    def file(self, kind: str, index: int) -> str:
        """Path in `folder` of a copy: `hr` the HR view, `lr` the degraded one, `up` it enlarged."""
        return f"{kind}/{self.all[index].number}.png"

    def size(self, kind: str, index: int) -> tuple[int, int]:
        """Width and height of a copy that is there, px."""
        return images.size(self.folder / self.file(kind, index))

    def read(self, kind: str, index: int) -> images.Photo:
        """A copy that is there."""
        return images.read(self.folder / self.file(kind, index))

    def enlarge(self, index: int) -> None:
        """Make the `up` copy, if it is not there."""
        file = self.folder / self.file("up", index)
        if not file.exists():
            target = self.all[index].frame
            images.save(file, images.resize(self.read("lr", index), target.width, target.height))


def prepare(scene: Scene, conf: VariantConf, work: Path) -> Photographs:
    """Read every photograph, drop what can't be read, shrink and crop the rest to HR views.

    All are shrunk by one scale: what one camera resolved better than another it still does.

    Raises:
        XrgsError: fewer than two can be read, or one is too small for its LR copy; named.
    """
    sizes, unreadable = _sizes(scene.files)
    shrink = scale(list(sizes.values()), conf) if sizes else 1.0
    kept: dict[Path, Frame] = {}
    for file, size in progress(sizes.items(), "HR views", "view"):
        try:
            photo = images.read(file)
        except images.ImageError as error:
            unreadable[file] = str(error)
            continue
        try:
            kept[file] = target = frame(size, shrink, conf)
        except XrgsError as error:
            raise XrgsError(f"{file}: {error}") from None
        left, top = target.corner
        shrunk = images.resize(photo, *target.resized)
        cut = shrunk[top : top + target.height, left : left + target.width]
        images.save(work / "hr" / f"{len(kept) - 1:05d}.png", cut)
    messages = tuple(unreadable[file] for file in scene.files if file in unreadable)
    for message in messages:
        _log.warning("%s; left out", message)
    if len(kept) < 2:
        raise XrgsError(f"scene {scene.name}: {len(kept)} readable image(s): {list(messages)}")
    cameras = share_cameras(list(kept), [sizes[file] for file in kept], conf.sfm.camera)
    photos = (
        Photograph(
            file.stem, f"{i:05d}", sizes[file], kept[file], camera, scene.intrinsics.get(file.stem)
        )
        for i, (file, camera) in enumerate(zip(kept, cameras, strict=True))
    )
    return Photographs(tuple(photos), work, messages)


def _sizes(files: Sequence[Path]) -> tuple[dict[Path, tuple[int, int]], dict[Path, str]]:
    """Width and height of each file, and what is wrong with those that have none."""
    sizes: dict[Path, tuple[int, int]] = {}
    unreadable: dict[Path, str] = {}
    for file in files:
        try:
            sizes[file] = images.size(file)
        except images.ImageError as error:
            unreadable[file] = str(error)
    return sizes, unreadable


def share_cameras(files: Sequence[Path], sizes: Sequence[tuple[int, int]], how: str) -> list[str]:
    """A camera's name for each file; those of one name share it, so they are of one size.

    Args:
        files: The photographs.
        sizes: Their width and height, upright: a camera held upright is another one to SfM.
        how: `sfm.camera`.

    Raises:
        XrgsError: `single`, but the sizes differ.
    """
    alike = len(set(sizes)) == 1
    if how == "single":
        if not alike:
            other = next(i for i, size in enumerate(sizes) if size != sizes[0])
            a, b = (f"{files[i]} is {sizes[i][0]}x{sizes[i][1]}" for i in (0, other))
            raise XrgsError(f"variant.sfm.camera=single, but sizes differ: {a}, {b}")
        return ["all"] * len(files)
    if how == "per_image":
        return [f"{i:05d}" for i in range(len(files))]
    names = []
    for i, (file, size) in enumerate(zip(files, sizes, strict=True)):
        mark = images.camera_mark(file)
        # Of photographs that tell no camera and differ in size, two alike are so by chance.
        alone = not mark and not alike
        names.append(f"{i:05d}" if alone else f"{size[0]}x{size[1]} {mark}")
    return names


def write_degraded(photos: Photographs, which: Sequence[int], conf: VariantConf) -> None:
    """The degraded copies of some photographs, in `lr`."""
    for i in progress(which, "LR views", "view"):
        low = degrade.degrade(photos.read("hr", i), conf)
        images.save(photos.folder / photos.file("lr", i), low)
