"""Makes HR views on disk from photographs, and decides which photographs share a camera."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from xrgs.config import VariantConf
from xrgs.errors import UnreadableError, XrgsError
from xrgs.mixture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.mixture.split import HrGeometry, TooSmallError, hr_geometry, shrink_factor
from xrgs.photos import exif, images, masks
from xrgs.photos.lens import Lens, lens_of_model, undistort
from xrgs.photos.masks import MASKS, Mask, Masks, copy_mask
from xrgs.photos.scenes import Scene
from xrgs.runtime.progress import progress
from xrgs.runtime.text import listed
from xrgs.safeio.hashing import digest

#: Least average number of photographs for each size at which photographs without EXIF of the same
#: size are assumed to be from one camera. Our choice.
_LEAST_OF_SIZE = 5

_Content = TypeVar("_Content")
_T = TypeVar("_T", np.float32, np.bool_)


@dataclass(frozen=True)
class Photograph:
    """A photograph of a scene."""

    name: str
    """Name of its view."""
    number: str
    """Name of its copies on disk, since COLMAP may not accept the names of users' files."""
    size: tuple[int, int]
    """Width and height of the file, after applying the EXIF orientation, px."""
    orientation: int
    """The applied EXIF orientation, 1 to 8; 1 is upright."""
    hr: HrGeometry
    """Size and crop of its HR view."""
    sfm: tuple[int, int]
    """Width and height of the whole photograph in SfM, px."""
    camera: str
    """Name of its camera; photographs with the same name share the camera in SfM."""
    K: NDArray[np.float64] | None
    """Intrinsics [3, 3] of the file, px, if known; then there is no distortion."""
    focal_35mm: float | None
    """Focal length from EXIF, mm, equivalent for a film of 36 x 24 mm; None if unknown."""
    path: Path
    """The file."""

    @property
    def lens(self) -> Lens | None:
        """Camera of the file; None if it is not known."""
        if self.K is None:
            return None
        K = self.K
        return lens_of_model("PINHOLE", self.size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))

    def to_hr(self, lens: Lens) -> Lens:
        """Return the camera of the HR view from that of the whole photograph at any size."""
        return lens.resized(*self.hr.resized).cropped(
            *self.hr.crop_offset, self.hr.width, self.hr.height
        )


@dataclass(frozen=True)
class PhotoCollection:
    """The usable photographs of a scene, sorted by name, and their copies in a work folder.

    The kinds of copies are

    - `hr`, the HR view, and `lr`, the degraded view;
    - `sfm`, the whole photograph for SfM, and `sfm_lr`, the degraded `sfm`;
    - `sfm_up` and `sfm_lr_up`, `sfm` and `sfm_lr` resized to `Photograph.sfm`;
    - `shown`, only of photographs with a mask: the HR view including the masked pixels.

    A copy may have a mask. In all kinds except `shown`, masked pixels have the colour of the
    nearest used pixel.
    """

    all: tuple[Photograph, ...]
    folder: Path
    notes: tuple[str, ...] = ()
    """Sentences on photographs that were left out, turned, converted or composited."""

    def __len__(self) -> int:
        return len(self.all)

    def __getitem__(self, index: int) -> Photograph:
        return self.all[index]

    @property
    def names(self) -> list[str]:
        """Names of the photographs, in order."""
        return [photo.name for photo in self.all]

    def file(self, kind: str, index: int) -> str:
        """Return the path of a copy in `folder`; the copy may not exist."""
        return f"{kind}/{self.all[index].number}.png"

    def size(self, kind: str, index: int) -> tuple[int, int]:
        """Return width and height of an existing copy, px."""
        return images.size(self.folder / self.file(kind, index))

    def read(self, kind: str, index: int) -> images.ImageArray:
        """Read an existing copy, [H, W, 3] in 0..1."""
        return images.read(self.folder / self.file(kind, index))

    def mask(self, kind: str, index: int) -> Mask | None:
        """Read the mask of an existing copy, [H, W]; None if all pixels are used."""
        file = copy_mask(self.folder, self.file(kind, index))
        return images.read_mask(file, self.size(kind, index)) if file.exists() else None

    def save_mask(self, kind: str, index: int, mask: Mask | None) -> None:
        """Write the mask of a copy; None writes nothing."""
        if mask is not None:
            images.save_mask(copy_mask(self.folder, self.file(kind, index)), mask, durable=False)

    def upsampled(self, kind: str, index: int) -> str:
        """Resize a copy to `Photograph.sfm` if needed; return the kind of the copy of this size."""
        target, up = self.all[index].sfm, f"{kind}_up"
        if self.size(kind, index) == target:
            return kind
        file = self.folder / self.file(up, index)
        if not file.exists():
            images.save(file, images.resize(self.read(kind, index), *target), durable=False)
            self.save_mask(up, index, masks.resized(self.mask(kind, index), *target))
        return up

    def undistorted(
        self, kind: str, index: int, lens: Lens
    ) -> tuple[images.ImageArray, Mask | None]:
        """Undistort a copy, `hr` or `lr`, and its mask; `lens` is the camera of the copy.

        Returns:
            The image [H, W, 3], not clamped; an HR view includes the masked pixels of the
            photograph. The mask [H, W], or None if all pixels are used.
        """
        image, mask = undistort(self.read(kind, index), lens), self.mask(kind, index)
        if mask is None:
            return image, None
        used = masks.undistorted(mask, lens)
        if kind == "hr":
            image = np.where(used[..., None], image, undistort(self.read("shown", index), lens))
        return image, used


def prepare_hr_views(
    scene: Scene, conf: VariantConf, work: Path, *, for_sfm: bool = False
) -> PhotoCollection:
    """Decode every photograph once, and write an HR view of each usable photograph.

    All photographs are resized by the same factor, which preserves their ratios of resolution.
    Unusable photographs are left out, and listed in the notes. With `for_sfm` the `sfm` copies are
    written too.

    Raises:
        UnreadableError: A photograph can't be read at the moment. It is not left out, since the
            variant must not depend on failures of a disk or server.
        XrgsError: Fewer than two photographs are usable, or one is too large for a variant; the
            message names the photographs. Or a mask can't be read, or does not fit its photograph.
    """
    (work / MASKS).mkdir(exist_ok=True)
    headers, left_out = _read_headers(scene.files)
    given = Masks.fitted(scene.masks, headers)
    numbers = {name: f"{i:05d}" for i, name in enumerate(scene.files)}
    geometries: dict[str, HrGeometry] = {}
    phrases: dict[str, list[str]] = defaultdict(list)
    usable = _usable(scene, conf, headers, left_out, images.decode)
    sizes: list[tuple[int, int]] = []  # the largest is the first
    for name, hr, picture in progress(usable, "HR views", "view", len(headers)):
        file = f"{numbers[name]}.png"
        own_mask, of_mask = given.read(name, headers[name])
        mask = _used(picture, own_mask, scene)
        image, shown = _layers(picture, mask, scene)
        if not _save_hr(work, file, image, shown, mask, hr):
            left_out[name] = "its mask leaves no pixel"
            continue
        if for_sfm:
            sizes.append(headers[name].size)
            _save_sfm(work, file, image, mask, _sfm_size(sizes[-1], sizes, conf))
        geometries[name] = hr
        for phrase in (*_phrases(picture, scene), *filter(None, [of_mask])):
            phrases[phrase].append(name)
    photos = _photographs(scene, conf, headers, left_out, geometries)
    return PhotoCollection(photos, work, (*given.notes, *_notes(scene, left_out, phrases)))


def expected_photographs(scene: Scene, conf: VariantConf) -> PhotoCollection:
    """Predict the result of `prepare_hr_views`, without copies, from the headers of the files.

    A note names those that will be left out. Damage after a header is not noticed. It raises as
    `prepare_hr_views` does.
    """
    headers, left_out = _read_headers(scene.files)
    usable = _usable(scene, conf, headers, left_out, lambda _: None)
    geometries = {name: hr for name, hr, _ in usable}
    photos = _photographs(scene, conf, headers, left_out, geometries)
    notes = (*Masks.fitted(scene.masks, headers).notes, *_notes(scene, left_out, {}))
    return PhotoCollection(photos, Path(), notes)


def _usable(
    scene: Scene,
    conf: VariantConf,
    headers: Mapping[str, images.Header],
    left_out: dict[str, str],
    read: Callable[[Path], _Content],
) -> Iterator[tuple[str, HrGeometry, _Content]]:
    """Yield name, HR geometry and content of each usable photograph; add others to `left_out`."""
    shrink: float | None = None
    # Largest first, so that the largest readable file, not a damaged one, decides the factor.
    for name in sorted(headers, key=lambda name: max(headers[name].size), reverse=True):
        file, size = scene.files[name], headers[name].size
        try:
            content = read(file)
            shrink = shrink or shrink_factor([size], conf.long_side)
            hr = _checked_geometry(size, shrink, conf)
        except images.ImageError as error:
            left_out[name] = str(error).removeprefix(f"{file}: ")
            continue
        except TooSmallError as error:
            left_out[name] = error.why
            continue
        except UnreadableError:
            raise
        except XrgsError as error:
            raise XrgsError(f"{file}: {error}") from None
        yield name, hr, content


def _photographs(
    scene: Scene,
    conf: VariantConf,
    headers: Mapping[str, images.Header],
    left_out: Mapping[str, str],
    geometries: Mapping[str, HrGeometry],
) -> tuple[Photograph, ...]:
    """Describe the usable photographs, sorted by name; refuse fewer than two."""
    if len(geometries) < 2:
        count = f"{len(geometries)} photograph(s) can be used, two are needed"
        reasons = f"{scene.name}: {count}: {_reasons(scene, left_out)}"
        sizes = [header.size for header in headers.values()]
        try:
            for size in sizes:
                hr_geometry(size, shrink_factor(sizes, conf.long_side), conf)
        except TooSmallError as error:
            reasons += f"; {error.advice}"
        raise XrgsError(f"scene {reasons}")
    numbers = {name: f"{i:05d}" for i, name in enumerate(scene.files)}
    names = sorted(geometries)
    files, sizes = [scene.files[name] for name in names], [headers[name].size for name in names]
    taken = [exif.read(file) for file in files]
    shapes, cameras = largest_of_shape(sizes), assign_cameras(files, sizes, conf.sfm.camera)
    return tuple(
        Photograph(
            name=name,
            number=numbers[name],
            size=headers[name].size,
            orientation=headers[name].orientation,
            hr=geometries[name],
            sfm=_sfm_size(shape, sizes, conf),
            camera=camera,
            K=scene.intrinsics.get(name),
            # The EXIF of a crop may have the focal length of the whole picture.
            focal_35mm=None if of.cut else of.focal_35mm,
            path=scene.files[name],
        )
        for name, shape, camera, of in zip(names, shapes, cameras, taken, strict=True)
    )


def _used(picture: images.Picture, given: Mask | None, scene: Scene) -> Mask | None:
    """Combine the mask and alpha of a photograph; None if all pixels are used."""
    used = np.ones(picture.pixels.shape[:2], np.bool_) if given is None else given
    if scene.alpha == "mask" and picture.alpha is not None:
        used = used & (picture.alpha >= images.OPAQUE_FROM)
    return None if used.all() else used


def _layers(
    picture: images.Picture, mask: Mask | None, scene: Scene
) -> tuple[images.ImageArray, images.ImageArray]:
    """Return a photograph with masked pixels filled, and the `shown` copy with them."""
    shown = picture.pixels
    if picture.alpha is not None:
        shown = images.composite(shown, picture.alpha, scene.background)
    image = picture.pixels if scene.alpha == "mask" else shown
    return masks.filled(image, mask), shown


def _save_hr(
    work: Path,
    file: str,
    image: images.ImageArray,
    shown: images.ImageArray,
    mask: Mask | None,
    hr: HrGeometry,
) -> bool:
    """Write the HR view of a photograph and its mask; return whether any pixel is used."""
    if mask is not None:
        small = _crop(masks.resized(mask, *hr.resized), hr)
        if not small.any():
            return False
        if not small.all():
            images.save(work / "shown" / file, _resize_and_crop(shown, hr), durable=False)
            images.save_mask(copy_mask(work, f"hr/{file}"), small, durable=False)
    images.save(work / "hr" / file, _resize_and_crop(image, hr), durable=False)
    return True


def _save_sfm(
    work: Path, file: str, image: images.ImageArray, mask: Mask | None, size: tuple[int, int]
) -> None:
    """Write the copy of a photograph for SfM, with its mask."""
    images.save(work / "sfm" / file, images.resize(image, *size), durable=False)
    small = masks.resized(mask, *size)
    if small is not None and not small.all():
        images.save_mask(copy_mask(work, f"sfm/{file}"), small, durable=False)


def _notes(
    scene: Scene, left_out: Mapping[str, str], phrases: Mapping[str, Sequence[str]]
) -> Iterator[str]:
    """Yield a sentence on the photographs left out, and one on each kind of conversion."""
    if left_out:
        yield f"left out: {_reasons(scene, left_out)}"
    for phrase, names in sorted(phrases.items()):
        yield f"{phrase}: {listed([_own_name(scene, name) for name in sorted(names)])}"


def _reasons(scene: Scene, left_out: Mapping[str, str]) -> str:
    """List the left-out photographs, grouped by reason."""
    names = defaultdict(list)
    for name, why in sorted(left_out.items()):
        names[why].append(_own_name(scene, name))
    return "; ".join(f"{listed(own)} ({why})" for why, own in names.items())


def _own_name(scene: Scene, name: str) -> str:
    return f"{name}{scene.files[name].suffix}"


def _phrases(picture: images.Picture, scene: Scene) -> Iterator[str]:
    """Yield a phrase for each conversion of a picture."""
    if picture.orientation > 1:
        yield "turned upright by EXIF"
    yield from picture.notes
    if picture.alpha is not None:
        colour = ", ".join(f"{value:g}" for value in scene.background)
        yield (
            f"masked where alpha is below {images.OPAQUE_FROM:g} (scene.alpha=mask)"
            if scene.alpha == "mask"
            else f"transparent pixels laid over the colour [{colour}] of scene.background"
        )


def _checked_geometry(size: tuple[int, int], shrink: float, conf: VariantConf) -> HrGeometry:
    hr = hr_geometry(size, shrink, conf)
    if hr.width * hr.height > images.MAX_PNG_PIXELS:
        raise XrgsError(
            f"an HR view of {hr.width}x{hr.height} px has more than {images.MAX_PNG_PIXELS} "
            f"pixels; lower variant.long_side={conf.long_side}"
        )
    return hr


def _sfm_size(
    size: tuple[int, int], sizes: Sequence[tuple[int, int]], conf: VariantConf
) -> tuple[int, int]:
    shrink = shrink_factor(sizes, conf.sfm.long_side)
    return max(1, round(size[0] * shrink)), max(1, round(size[1] * shrink))


def _resize_and_crop(image: images.ImageArray, hr: HrGeometry) -> images.ImageArray:
    return _crop(images.resize(image, *hr.resized), hr)


def _crop(image: NDArray[_T], hr: HrGeometry) -> NDArray[_T]:
    left, top = hr.crop_offset
    return image[top : top + hr.height, left : left + hr.width]


def _read_headers(
    files: Mapping[str, Path],
) -> tuple[dict[str, images.Header], dict[str, str]]:
    """Read the headers: name -> header of a photograph, and name -> why it is not usable."""
    headers: dict[str, images.Header] = {}
    left_out: dict[str, str] = {}
    for name, file in files.items():
        try:
            headers[name] = images.header(file)
        except images.ImageError as error:
            left_out[name] = str(error).removeprefix(f"{file}: ")
    depth = [name for name, header in headers.items() if header.is_deep_grey]
    if len(depth) < len(headers):
        for name in depth:
            del headers[name]
            left_out[name] = (
                "taken for a depth map: it has one channel of more than 8 bits, and others have not"
            )
    return headers, left_out


def largest_of_shape(sizes: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return for each width and height the largest of `sizes` with the same aspect ratio.

    Ratios count as equal if rounding a side by one px explains the difference, as in resized
    copies.
    """
    distinct = sorted(set(sizes), key=math.prod, reverse=True)

    def largest(width: int, height: int) -> tuple[int, int]:
        return next(s for s in distinct if abs(width * s[1] / s[0] - height) <= 1)

    return [largest(*size) for size in sizes]


def assign_cameras(
    files: Sequence[Path], sizes: Sequence[tuple[int, int]], policy: str
) -> list[str]:
    """Name the camera of each photograph; photographs with the same name share it in SfM.

    `sizes` are after EXIF's turn, px: a camera has one aspect ratio, and held upright it is a
    different camera for SfM. `policy` is `variant.sfm.camera`: `single` for one camera, `per_image`
    for one for each photograph, `auto` for one for each aspect ratio, EXIF camera, digital zoom and
    crop.

    Raises:
        XrgsError: The policy is `single`, but the aspect ratios differ.
    """
    shapes = largest_of_shape(sizes)
    if policy == "single":
        if len(set(shapes)) > 1:
            other = next(i for i, shape in enumerate(shapes) if shape != shapes[0])
            a, b = (f"{files[i]} is {sizes[i][0]}x{sizes[i][1]}" for i in (0, other))
            raise XrgsError(
                f"variant.sfm.camera=single, but shapes differ: {a}, {b}; use auto or per_image"
            )
        return ["all"] * len(files)
    own = [f"{i:05d}" for i in range(len(files))]
    if policy == "per_image":
        return own
    taken = [exif.read(file) for file in files]
    unknown = [size for size, of in zip(sizes, taken, strict=True) if not of.camera]
    # Equal sizes of few photographs are coincidence, of many they are from the same camera.
    by_size = len(set(sizes)) == 1 or len(unknown) >= _LEAST_OF_SIZE * len(set(unknown))
    names = []
    for i, (size, shape, of) in enumerate(zip(sizes, shapes, taken, strict=True)):
        if of.camera:
            names.append(f"{shape[0]}x{shape[1]} {of.camera} {of.cut}")
        else:
            names.append(f"{size[0]}x{size[1]} {of.cut}" if by_size else own[i])
    return names


def write_degraded(
    photos: PhotoCollection, which: Sequence[int], conf: VariantConf, kind: str = "lr"
) -> None:
    """Degrade the views with indices `which`: `hr` into `lr`, or for `sfm_lr`, `sfm` into it."""
    if not which:
        return
    degrade = DEGRADATIONS[resolve_degradation(conf)].function
    for i in progress(which, "LR views", "view"):
        source = "hr" if kind == "lr" else "sfm"
        high, mask = photos.read(source, i), photos.mask(source, i)
        if kind == "sfm_lr":  # HR views already have such a size
            size = _divisible(*photos.size("sfm", i), conf.factor)
            high, mask = images.resize(high, *size), masks.resized(mask, *size)
        # The random numbers of a view do not depend on the other views.
        random = np.random.default_rng(int(digest([conf.seed, photos.names[i]]), 16))
        low = degrade(high, conf, random)
        images.save(photos.folder / photos.file(kind, i), low, durable=False)
        photos.save_mask(kind, i, masks.degraded(mask, low.shape[:2], conf.factor))


def _divisible(width: int, height: int, factor: int) -> tuple[int, int]:
    """Return a size with sides that are multiples of `factor`, at most 2% smaller than the given.

    Among these sizes, it has the aspect ratio closest to the given one.
    """
    most = max(1, width // factor)
    columns = min(
        range(most, most - 1 - most // 50, -1),
        key=lambda c: abs(c * height / width - round(c * height / width)),
    )
    return columns * factor, max(1, round(columns * height / width)) * factor
