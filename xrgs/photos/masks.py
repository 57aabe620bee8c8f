"""Finds the masks of photographs, and brings them to the sizes of the views.

A mask is an image in which white pixels are used and black ones are not, as in COLMAP. A pixel of a
resized or undistorted view is used if nearly all of its source pixels are used.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import UnreadableError, XrgsError
from xrgs.photos import images
from xrgs.photos.images import Header
from xrgs.photos.lens import Lens, undistort
from xrgs.runtime.text import listed
from xrgs.safeio.files import walk_files
from xrgs.safeio.paths import user_path

Mask = NDArray[np.bool_]  # [H, W], True for a pixel that is used

_T = TypeVar("_T", np.float32, np.uint8)
#: The folder of masks in a folder of copies, as COLMAP expects it.
MASKS = "masks"
#: Words for masks in names of files and folders.
WORDS = r"masks?|segmentations?|seg|segments|mattes?|silhouettes?"
#: The words before or after the photograph's name in the name of its mask.
_AFFIX = re.compile(rf"^(?:{WORDS}|alpha)[\W_]|[\W_](?:{WORDS}|alpha)$", re.IGNORECASE)
#: The brightness from which a pixel of a mask is white: half-way to black.
_WHITE = 0.5
#: The brightness of the 8-bit value 1: some programs write masks as labels 0 and 1.
_LABEL = 1 / 255
#: A mask may be another picture if more than this share of its pixels is neither black (brightness
#: below _BLACK_BELOW) nor white (above 1 - _BLACK_BELOW).
_MOST_BETWEEN, _BLACK_BELOW = 0.05, 0.1
_GREY = "masks that are not black and white, of which what is brighter than grey is used"
#: A resampled pixel is used if at least this share of its source is used.
_NEARLY_ALL = 0.99


def find(folder: str, photographs: Mapping[str, Path]) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Find the masks of photographs in a folder and all folders below it.

    The mask of `IMG_1.jpg` is `IMG_1` with the suffix of any image, `IMG_1.jpg.png`, or one of
    these with `mask` before or after the name. The names of its folders come before its name, as
    for photographs. Case is ignored.

    Args:
        folder: `scene.masks`.
        photographs: The photographs by name. If they lie in the folder, they are skipped.

    Returns:
        The masks by the names of the photographs, and sentences on photographs without a mask and
        on masks without a photograph.

    Raises:
        XrgsError: The folder is missing, none of its images is the mask of a photograph, or two are
            masks of one.
    """
    root = user_path(folder)
    wanted = {_key(name): name for name in photographs}
    own = {file.resolve() for file in photographs.values()}
    found: dict[str, Path] = {}
    others = []
    for inside in _images_below(root):
        if (root / inside).resolve() in own:
            continue
        name = next((wanted[key] for key in _keys(inside) if key in wanted), None)
        if name is None:
            others.append(str(inside))
        elif name in found:
            pair = f"{found[name].relative_to(root)} and {inside}"
            raise XrgsError(f"scene.masks={root}: {pair} are both masks of {name}; remove one")
        else:
            found[name] = root / inside
    if not found:
        there = f"only {listed(others)}" if others else "no image"
        first = min(wanted.values())
        raise XrgsError(
            f"scene.masks={root}: no mask of a photograph in it, {there}; the mask of {first} is"
            f" {first}.png"
        )
    notes = []
    if missing := [name for name in wanted.values() if name not in found]:
        notes.append(f"no mask in scene.masks, so that all pixels are used: {listed(missing)}")
    if others:
        notes.append(f"masks of no photograph in scene.masks: {listed(others)}")
    return dict(sorted(found.items())), tuple(notes)


def _images_below(root: Path) -> list[Path]:
    """Return the images below a folder by their paths in it, sorted, without hidden ones."""
    if not root.is_dir():
        raise XrgsError(f"scene.masks={root}: no such folder")
    try:
        inside = [Path(name) for name, _ in walk_files(root)]
    except OSError as error:
        raise UnreadableError(f"{error.filename}: {error.strerror}; try again") from error
    return sorted(
        path
        for path in inside
        if path.suffix.lower() in images.SUFFIXES
        and not any(part.startswith(".") for part in path.parts)
    )


def _keys(inside: Path) -> Iterator[str]:
    """Yield the keys (see `_key`) of photographs whose mask may have this path."""
    for stem in dict.fromkeys((inside.stem, _AFFIX.sub("", inside.stem))):
        yield _key("_".join([*inside.parent.parts, stem]))
        if Path(stem).suffix.lower() in images.SUFFIXES:
            yield _key("_".join([*inside.parent.parts, Path(stem).stem]))


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


@dataclass(frozen=True)
class Masks:
    """The masks of photographs, and which of them EXIF's orientation must turn."""

    files: Mapping[str, Path]
    """The masks by the names of the photographs."""
    turned: frozenset[str]
    """Names of the photographs whose masks match the stored pixels, and are turned with them."""
    notes: tuple[str, ...]
    """A sentence on masks that fit both turned and not turned."""

    @classmethod
    def fitted(cls, files: Mapping[str, Path], headers: Mapping[str, Header]) -> Masks:
        """Decide for each mask whether it matches its photograph as stored, or turned by EXIF.

        The shape decides. Square photographs and those turned by 180 degrees fit both ways; their
        masks follow the others of the folder.

        Args:
            files: The masks by the names of the photographs; names not in `headers` are left out.
            headers: The headers of the photographs.

        Raises:
            XrgsError: A mask has another shape than its photograph, or is no image.
        """
        files = {name: file for name, file in files.items() if name in headers}
        stored, seen, either = set[str](), set[str](), set[str]()
        for name, file in files.items():
            photograph, mask = headers[name], images.header(file)
            width, height = photograph.size
            as_stored = images.turned_size(photograph.size, photograph.orientation)
            fits_seen = _same_shape(mask.size, (width, height))
            if not fits_seen and not _same_shape(mask.size, as_stored):
                raise XrgsError(
                    f"{file}: a mask of {mask.size[0]} x {mask.size[1]} px is of another picture"
                    f" than {name}, which has {width} x {height} px"
                )
            if photograph.orientation == 1:
                continue
            if not fits_seen:
                stored.add(name)
            elif mask.orientation > 1 or not _same_shape(mask.size, as_stored):
                seen.add(name)  # the mask's own EXIF orientation turns it
            else:
                either.add(name)
        notes = []
        if stored and not seen:
            stored |= either
        elif either and bool(stored) == bool(seen):
            notes.append(
                "masks that fit a photograph both as stored and as turned by EXIF are taken as"
                f" turned: {listed(sorted(either))}"
            )
        return cls(files, frozenset(stored), tuple(notes))

    def read(self, name: str, photograph: Header) -> tuple[Mask | None, str]:
        """Read the mask [H, W] of a photograph, at its size; None if there is none.

        The note is empty for a black and white mask.
        """
        if name not in self.files:
            return None, ""
        picture = images.decode(self.files[name])
        bright = picture.pixels.max(axis=-1)  # a colour is as white as its brightest channel
        if picture.alpha is not None:
            bright *= picture.alpha
        largest = float(bright.max())
        mask: Mask = bright > 0 if largest < 1.5 * _LABEL else bright >= _WHITE
        is_between = (bright > _BLACK_BELOW) & (bright < 1 - _BLACK_BELOW)
        note = _GREY if largest >= 1.5 * _LABEL and is_between.mean() > _MOST_BETWEEN else ""
        if name in self.turned:
            mask = images.turned(mask, photograph.orientation)
        nearest = [
            ((np.arange(wanted) + 0.5) * given / wanted).astype(int)
            for wanted, given in zip(photograph.size[::-1], mask.shape, strict=True)
        ]
        return mask[np.ix_(*nearest)], note


def copy_mask(folder: Path, file: str) -> Path:
    """Return the path of the mask of the copy `folder/file`, where COLMAP looks for it."""
    return folder / MASKS / f"{file}.png"


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect ratio, up to the rounding of a side."""
    (w, h), (width, height) = one, other
    return abs(h - height * w / width) < 1 or abs(w - width * h / height) < 1


@overload
def resized(mask: Mask, width: int, height: int) -> Mask: ...
@overload
def resized(mask: None, width: int, height: int) -> None: ...
def resized(mask: Mask | None, width: int, height: int) -> Mask | None:
    """Resize a mask [H, W]: a pixel is used if nearly all of its source pixels are used."""
    if mask is None or mask.shape == (height, width):
        return mask
    import torch
    from torch.nn.functional import interpolate

    batch = torch.from_numpy(np.ascontiguousarray(mask)).float()[None, None]
    share = interpolate(batch, size=(height, width), mode="bilinear", antialias=True)
    used: Mask = share[0, 0].numpy() >= _NEARLY_ALL
    return used


def degraded(mask: Mask | None, size: tuple[int, int], factor: int) -> Mask | None:
    """Return the mask of an LR view of `size` (height, width), from the mask of its HR view.

    The mask is reduced by `factor` and enlarged to `size`, as a view is that keeps its size.
    """
    if mask is None:
        return None
    height, width = size
    small = resized(mask, mask.shape[1] // factor, mask.shape[0] // factor)
    return resized(small, width, height)


def undistorted(mask: Mask, lens: Lens) -> Mask:
    """Undistort a mask as `xrgs.photos.lens.undistort` does its image."""
    share = undistort(mask[..., None].astype(np.float32), lens, order=1)
    used: Mask = share[..., 0] >= _NEARLY_ALL
    return used


def filled(image: NDArray[_T], mask: Mask | None) -> NDArray[_T]:
    """Give each pixel of an image [H, W, 3] that is not used the colour of the nearest used one.

    Hidden content then reaches no used pixel by resampling, and no window of SSIM. The result is
    the image itself if all or none of its pixels are used.
    """
    if mask is None or not mask.any():
        return image
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    nearest: NDArray[_T] = image[rows, columns]
    return nearest
