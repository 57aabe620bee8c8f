"""The poses of a user's file, for all formats: checked, and moved to a world near the origin.

In UTM or Earth coordinates, a metre would be only a few steps of float32, which has 7 digits.
Training also depends slightly on the origin and axes of the world (`xrgs.splat.normalize`). So all
given poses are moved, in float64: the mean of the cameras becomes the origin, as in COLMAP's
models, and the axes are those of the first camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.mixture.photographs import PhotoCollection, Photograph
from xrgs.photos import images
from xrgs.photos.lens import Lens
from xrgs.runtime.text import listed

#: Function: name of an image, stored width and height of its photograph (px) -> the image's camera
#: (px of the image) and pose (world to camera [4, 4], OpenCV axes).
CameraOf = Callable[[str, tuple[int, int]], tuple[Lens, NDArray[np.float64]]]
#: Largest relative difference of aspect ratios that rounding sides to whole px explains.
_MAX_ASPECT = 0.01
#: Range of the focal length over the longer side: a field of view of 157 degrees (COLMAP's limit)
#: to half a degree.
_FOCAL_RANGE = (0.1, 100.0)
#: Largest ratio of the focal lengths of both axes; anamorphic lenses have 2.
_MAX_PIXEL_ASPECT = 3.0
#: Distance of the principal point from the middle, over the side, that a note tells. K for half or
#: twice the size has 0.5 and 0.25.
_MOST_OFF_CENTRE = 0.2
#: Largest ratio of the sides of a picture and of its smaller copy.
_MOST_SMALLER = 16
#: Least extent of the cameras over the distance of their points. Below it, points move by less than
#: about a tenth of a pixel between cameras, so that depths are unknown. Our choice.
_LEAST_BASELINE = 1e-4
#: Relative rounding error of differences of large float64 numbers.
_ROUNDING = 1e-14
#: Largest rounding of points relative to their distances; coarser points are not used.
_MOST_ROUNDED = 1e-3


@dataclass(frozen=True)
class GivenPoses:
    """The cameras and points of a user's file."""

    names: Sequence[str]
    """Names of the images with a pose, with folders and suffix as in the file."""
    camera: CameraOf
    """Reads one camera; raises XrgsError if it is malformed."""
    points: NDArray[np.float64]
    """Points [P, 3]; P may be 0."""
    colors: NDArray[np.uint8]
    """Colours of the points [P, 3]."""
    observed: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    """Image name -> ascending indices of its observed points, if known."""
    report: Mapping[str, Any] = field(default_factory=dict)
    """Entries for the variant's report, besides the notes."""
    notes: Sequence[str] = ()
    """Sentences on data that was chosen, left out or ignored."""


def same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect ratio."""
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1) <= _MAX_ASPECT


def check_camera(lens: Lens, photo: Photograph) -> None:
    """Refuse the camera of another picture, and an impossible camera.

    `lens` is the camera of the upright photograph, at the size in the file of poses. XrgsError says
    that the aspect ratios differ, or that the focal length or principal point is impossible.
    """
    size = lens.width, lens.height
    if not same_shape(size, photo.size):
        raise XrgsError(
            f"the camera of {photo.name} is for images of {size[0]}x{size[1]} px, and the "
            f"photograph has {photo.size[0]}x{photo.size[1]}: these are not the same picture"
        )
    fx, fy, cx, cy = lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2]
    shown = f"the camera of {photo.name}, for {size[0]}x{size[1]} px, "
    least, most = (limit * max(size) for limit in _FOCAL_RANGE)
    if not least <= min(fx, fy) <= max(fx, fy) <= most:
        raise XrgsError(
            f"{shown}has a focal length of {fx:g} and {fy:g} px; {least:g} to {most:g} px can be "
            "(a focal length is in px, and camera_angle_x in radians)"
        )
    if max(fx, fy) > _MAX_PIXEL_ASPECT * min(fx, fy):
        raise XrgsError(f"{shown}has focal lengths of {fx:g} and {fy:g} px, too unequal")
    if abs(cx / size[0] - 0.5) > 1.5 or abs(cy / size[1] - 0.5) > 1.5:
        raise XrgsError(f"{shown}has its principal point at {cx:g}, {cy:g} px, far outside of it")


def off_centre(lenses: Mapping[int, Lens], photos: PhotoCollection) -> list[str]:
    """Return a note on cameras with a principal point far from the middle of their images.

    A file whose sizes were changed and whose focal lengths were not has such cameras.
    """
    odd = {
        i: (lens.K[0, 2] / lens.width, lens.K[1, 2] / lens.height)
        for i, lens in lenses.items()
        if max(abs(lens.K[0, 2] / lens.width - 0.5), abs(lens.K[1, 2] / lens.height - 0.5))
        > _MOST_OFF_CENTRE
    }
    if not odd:
        return []
    first, (x, y) = next(iter(odd.items()))
    size = f"{lenses[first].width}x{lenses[first].height}"
    return [
        f"the cameras of {len(odd)} photographs have their principal point far from the middle, as "
        f"at {x:.0%} of the width and {y:.0%} of the height of {size} px: right for crops, and "
        f"wrong if only the size was changed: {listed([photos.names[i] for i in odd])}"
    ]


def check_places(centres: NDArray[np.float64], points: NDArray[np.float64], far: float) -> None:
    """Refuse cameras that are all at the same place, from which depths can't be measured.

    Args:
        centres: The cameras' centres [N, 3], with the mean at the origin, world units.
        points: The points [P, 3], with the same origin; there may be none.
        far: Distance of this origin from the origin of the given world, for its rounding errors,
            world units.
    """
    extent = np.linalg.norm(centres, axis=1).max()
    distance = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
    if len(centres) > 1 and extent <= max(_LEAST_BASELINE * distance, _ROUNDING * far):
        raise XrgsError(
            f"all {len(centres)} cameras are at one place, so that nothing has a depth; "
            "are these the poses of a panorama, or has every frame the same matrix?"
        )


def of_other_pictures(
    lenses: Mapping[int, Lens], names: Mapping[int, str], photos: PhotoCollection, source: Path
) -> list[str]:
    """Return a note on cameras of pictures that are neither the photographs nor smaller copies.

    Such pictures may be those that COLMAP undistorted, whose sides differ by a few px. If pictures
    with exactly the cameras' sizes are in a folder next to the poses, XrgsError names it.

    Args:
        lenses: Index of an upright photograph -> its camera, at the size in the file of poses.
        names: Index of a photograph -> name of its image in the poses.
        photos: The photographs.
        source: The file or folder of the poses.
    """
    odd = [i for i, of in lenses.items() if not _is_copy((of.width, of.height), photos[i].size)]
    for i in odd:
        size = lenses[i].width, lenses[i].height
        for folder in (source, *source.absolute().parents[:3]):
            for file in (folder / "images" / names[i], folder / PurePosixPath(names[i])):
                if _size(file) == size:
                    raise XrgsError(
                        f"its cameras are of {file.parent}, where {file.name} has "
                        f"{size[0]}x{size[1]} px, and not of {photos[i].path}, which has "
                        f"{photos[i].size[0]}x{photos[i].size[1]}: undistortion changes the "
                        f"picture; take scene.path={file.parent}"
                    )
    if not odd:
        return []
    lens, size = lenses[odd[0]], photos[odd[0]].size
    of_odd = listed([photos.names[i] for i in odd])
    return [
        f"the cameras of {len(odd)} photographs are of images of another size, as "
        f"{lens.width}x{lens.height} for {size[0]}x{size[1]} px: right for resized copies, and "
        f"wrong for images that were undistorted or cropped: {of_odd}"
    ]


def _size(file: Path) -> tuple[int, int] | None:
    try:
        return images.size(file)
    except XrgsError:
        return None


def _is_copy(size: tuple[int, int], photograph: tuple[int, int]) -> bool:
    """Return whether two sizes are equal, or differ by a whole factor."""
    if size == photograph:
        return True
    small, large = sorted((size, photograph))
    return any(
        all(abs(s - side / n) < 1 for s, side in zip(small, large, strict=True))
        for n in range(2, _MOST_SMALLER + 1)
    )


def own_world(
    viewmats: Mapping[int, NDArray[np.float64]],
) -> tuple[dict[int, NDArray[np.float64]], NDArray[np.float64]]:
    """Move rigid cameras, world to camera [4, 4], to the standard world.

    Returns:
        The viewmats in the new world, and the rigid transform [4, 4] from the given world to it.
    """
    R = np.stack([matrix[:3, :3] for matrix in viewmats.values()])
    t = np.stack([matrix[:3, 3] for matrix in viewmats.values()])
    mean = -np.einsum("nji,nj->ni", R, t).mean(axis=0)
    axes = viewmats[min(viewmats)][:3, :3]
    moved = {}
    for i, matrix in viewmats.items():
        moved[i] = np.eye(4)
        moved[i][:3, :3] = matrix[:3, :3] @ axes.T
        moved[i][:3, 3] = matrix[:3, :3] @ mean + matrix[:3, 3]
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = axes, -axes @ mean
    return moved, world


def moved_points(points: NDArray[np.float64], world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move points [P, 3] to the world of `own_world`."""
    axes = world[:3, :3]
    moved: NDArray[np.float64] = (points + axes.T @ world[:3, 3]) @ axes.T
    return moved


def rounding(points: NDArray[np.float64], moved: NDArray[np.float64]) -> float | None:
    """Return the size of float32's rounding steps if it is too coarse for the points, else None.

    `points` [P, 3] are in the given world, and `moved` in the world of `own_world`.
    """
    as_32_bits = points.astype(np.float32)
    if not len(points) or not (as_32_bits == points).all():
        return None
    step = float(np.spacing(np.abs(as_32_bits).max()))
    distance = float(np.median(np.linalg.norm(moved, axis=1)))
    return step if step > _MOST_ROUNDED * distance else None
