"""Registers the views of a mixed-resolution scene by SfM, with further attempts if that fails.

SfM gets whole photographs at `sfm.long_side`, independent of the size of HR views. Photographs that
the variant degrades are degraded at that size. With `sfm.lr_images: upsampled`, smaller images are
resized to the size of the largest image of the same aspect ratio, and share its camera. This makes
their poses several times more accurate. With `native`, smaller images keep their size, and have a
camera of that size.

The first attempt, `configured`, has the settings of `variant.sfm`. With `sfm.fallbacks`, the
attempts of `FALLBACKS` follow in order until a reconstruction is accepted. The first of these is
also made if `configured` is accepted but lacks views. If EXIF gives a focal length, which the other
attempts use as the initial value, an attempt without it is made after the first fallback.

Photographs that were cropped or zoomed may keep their EXIF, and so share a camera with the others.
If views of the best reconstruction fit better with another camera (`sfm.other_cameras`), the
attempt `cameras_apart` gives them one.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from xrgs.config import SfmConf
from xrgs.errors import XrgsError
from xrgs.mixture import sfm
from xrgs.mixture.photographs import PhotoCollection
from xrgs.mixture.views import MIN_POINTS, Reconstruction
from xrgs.photos import images, masks
from xrgs.runtime.progress import progress
from xrgs.runtime.text import listed

_log = logging.getLogger(__name__)

#: COLMAP's lower limit of inliers for an absolute pose.
_MIN_INLIERS = 6
#: Diagonal of 35 mm film, mm, by which CIPA defines 35 mm equivalent focal lengths.
_FILM_DIAGONAL = math.hypot(36, 24)
#: Keys of SfM's report that are stored for each attempt.
_ATTEMPT_KEYS = (
    "lr_images",
    "first_octave",
    "max_num_features",
    "init_min_tri_angle",
    "min_inliers",
    "registered",
    "models",
    "points",
    "reprojection_error_px",
)


@dataclass(frozen=True)
class Attempt:
    """The settings of one run of SfM."""

    name: str
    conf: SfmConf
    uses_exif: bool = True
    """Whether EXIF's focal lengths are the initial values of the refinement."""
    apart: Mapping[int, int] = field(default_factory=dict)
    """View that does not use the camera of its name -> number of its camera."""


def relaxed(conf: SfmConf, images: int, *, any_smaller: bool) -> Attempt:  # noqa: ARG001
    """Halve the required inliers per view; features and matches are reused, so it is quick."""
    return Attempt("relaxed", replace(conf, min_inliers=max(_MIN_INLIERS, conf.min_inliers // 2)))


def finer(conf: SfmConf, images: int, *, any_smaller: bool) -> Attempt:  # noqa: ARG001
    """Detect twice as many features, at twice the resolution."""
    features = 2 * sfm.features_per_image(images, conf.max_num_features)
    return Attempt("finer", replace(conf, max_num_features=features, first_octave=-1))


def narrower(conf: SfmConf, images: int, *, any_smaller: bool) -> Attempt:  # noqa: ARG001
    """Require only a quarter of the triangulation angle of the first pair."""
    return Attempt("narrower", replace(conf, init_min_tri_angle=conf.init_min_tri_angle / 4))


def other_size(conf: SfmConf, images: int, *, any_smaller: bool) -> Attempt | None:  # noqa: ARG001
    """Use `native` instead of `upsampled` LR images, or the reverse."""
    other = "native" if conf.lr_images == "upsampled" else "upsampled"
    return Attempt(other, replace(conf, lr_images=other)) if any_smaller else None


#: The attempts after the first, in order. Each function gets the settings of the previous attempt,
#: the number of images, and whether any is smaller than the largest; a result of None is skipped.
#: ALIKED and LightGlue are missing: pycolmap's wheels are built without ONNX, and abort the process
#: if these are used.
FALLBACKS = (relaxed, finer, narrower, other_size)


@dataclass(frozen=True)
class Registration:
    """The best reconstruction, and a report of every attempt."""

    model: Reconstruction
    refused: str
    """Why the best reconstruction is not accepted; empty if it is accepted."""
    attempt: Attempt
    """The attempt that made it."""
    attempts: list[dict[str, Any]]
    """Name, reason of refusal, time (seconds), settings and results of each attempt."""


def register(
    photos: PhotoCollection,
    degraded: Collection[int],
    conf: SfmConf,
    work: Path,
    refusal: Callable[[Reconstruction], str],
) -> Registration:
    """Run SfM on the mixed-resolution images, until a reconstruction is accepted.

    Args:
        photos: The photographs, with `sfm` copies, and `sfm_lr` copies of the degraded views.
        degraded: Indices of the views that are degraded for SfM.
        conf: The settings of the first attempt.
        work: An existing folder for SfM's files.
        refusal: Returns why a reconstruction is refused, or an empty text to accept it.

    Returns:
        The accepted reconstruction with the most registered views; if none is accepted, the
        refused one with the most. Of equal ones, the first.
    """
    best: tuple[Reconstruction, str, Attempt] | None = None
    reports: list[dict[str, Any]] = []
    folders: dict[tuple[object, ...], Path] = {}

    def run(attempt: Attempt) -> tuple[Reconstruction, str, Attempt]:
        start = time.perf_counter()
        # Attempts with the same features and matches share a folder, so that COLMAP reuses them.
        folder = folders.setdefault(_features_of(attempt), work / f"sfm-{attempt.name}")
        model = _reconstruct(photos, degraded, attempt, folder)
        reason = refusal(model)
        seconds = round(time.perf_counter() - start, 1)
        results = {key: model.report[key] for key in _ATTEMPT_KEYS if key in model.report}
        reports.append({"attempt": attempt.name, "refused": reason, "seconds": seconds} | results)
        if reason:
            _log.warning("SfM attempt %s: %s", attempt.name, reason)
        return model, reason, attempt

    any_smaller = any(
        photos.size(_kind(i, degraded), i) != photo.sfm for i, photo in enumerate(photos.all)
    )
    any_focal = any(photo.focal_35mm and photo.K is None for photo in photos.all)
    for attempt in sfm_attempts(conf, len(photos), any_smaller=any_smaller, any_focal=any_focal):
        found = run(attempt)
        if best is None or _rank(*found[:2]) > _rank(*best[:2]):
            best = found
        if not best[1] and (len(best[0].viewmats) == len(photos) or len(reports) > 1):
            break
    if best is None:
        raise RuntimeError("there is always a first attempt")
    if best[0].apart and conf.camera == "auto":
        found = run(replace(best[2], name="cameras_apart", apart=best[0].apart))
        if (*_rank(*found[:2]), -_error(found[0])) > (*_rank(*best[:2]), -_error(best[0])):
            best = found
    model, reason, attempt = best
    notes = [*model.report.get("notes", ()), *_notes(attempt, photos)]
    model = replace(model, report=model.report | {"notes": notes})
    return Registration(model, reason, attempt, reports)


def _error(model: Reconstruction) -> float:
    return float(model.report.get("reprojection_error_px", math.inf))


def _notes(attempt: Attempt, photos: PhotoCollection) -> Iterator[str]:
    """Yield notes on differences of an attempt from EXIF."""
    if not attempt.uses_exif:
        focals = sorted({photo.focal_35mm for photo in photos.all if photo.focal_35mm})
        shown = ", ".join(f"{focal:g}" for focal in focals)
        yield (
            f"the focal length in EXIF ({shown} mm of 35 mm film) was not used, since SfM failed"
            " with it: it may be wrong"
        )
    if attempt.apart:
        names = listed([photos.names[i] for i in sorted(attempt.apart)])
        yield (
            f"cropped or zoomed, though EXIF does not say so: {names} fit with another focal length"
            " than the others of their camera, and have a camera of their own"
        )


def _rank(model: Reconstruction, refused: str) -> tuple[bool, int]:
    return not refused, len(model.viewmats)


def sfm_attempts(
    conf: SfmConf, images: int, *, any_smaller: bool, any_focal: bool = False
) -> Iterator[Attempt]:
    """Yield the attempts to run SfM, in order; without `fallbacks` there is only the first.

    `any_smaller` says whether any image is smaller than its `Photograph.sfm`, and `any_focal`
    whether EXIF gives the focal length of any.
    """
    attempt = Attempt("configured", conf)
    yield attempt
    for fallback in FALLBACKS if conf.fallbacks else ():
        following = fallback(attempt.conf, images, any_smaller=any_smaller)
        if following is not None:
            attempt = following
            yield attempt
        if fallback is FALLBACKS[0] and any_focal:
            yield Attempt("without_exif", conf, uses_exif=False)


def _features_of(attempt: Attempt) -> tuple[object, ...]:
    """Return the settings that features, matches and initial cameras depend on."""
    conf = attempt.conf
    settings = conf.lr_images, conf.max_num_features, conf.first_octave
    return *settings, attempt.uses_exif, tuple(attempt.apart.items())


def sfm_images(
    photos: PhotoCollection, degraded: Collection[int], attempt: Attempt
) -> list[sfm.SfmImage]:
    """Return the image of each photograph for SfM, with known intrinsics; make upsampled copies.

    Photographs and degraded views are as for `register`.
    """
    result = []
    for i, photo in enumerate(photos.all):
        kind = _kind(i, degraded)
        if attempt.conf.lr_images == "upsampled":
            kind = photos.upsampled(kind, i)
        width, height = photos.size(kind, i)
        lens = photo.lens and photo.lens.resized(width, height)
        focal_35mm = photo.focal_35mm if attempt.uses_exif and i not in attempt.apart else None
        focal = focal_35mm and focal_35mm * math.hypot(width, height) / _FILM_DIAGONAL
        # With known intrinsics, each image has its own camera.
        camera = photo.name if lens else f"{photo.camera} {width}x{height}"
        if i in attempt.apart:
            camera += f" {attempt.apart[i]}"
        file, K = photos.file(kind, i), lens.K if lens else None
        masked = masks.copy_mask(photos.folder, file).exists()
        result.append(sfm.SfmImage(file, photo.name, camera, K, focal, masked))
    return result


def _kind(index: int, degraded: Collection[int]) -> str:
    return "sfm_lr" if index in degraded else "sfm"


def _reconstruct(
    photos: PhotoCollection, degraded: Collection[int], attempt: Attempt, work: Path
) -> Reconstruction:
    """Run SfM once, and convert the cameras to those of the HR views."""
    work.mkdir(exist_ok=True)
    given = sfm_images(photos, degraded, attempt)
    model = sfm.reconstruct(given, photos.folder, work, attempt.conf)
    lenses = {i: photos[i].to_hr(lens) for i, lens in model.lenses.items()}
    return replace(model, lenses=lenses)


def reconstruct_undegraded(photos: PhotoCollection, attempt: Attempt, work: Path) -> Reconstruction:
    """Run SfM once on the undegraded photographs, with the settings of an attempt."""
    return _reconstruct(photos, (), attempt, work / "sfm-reference")


def with_points(
    model: Reconstruction,
    photos: PhotoCollection,
    degraded: Collection[int],
    conf: SfmConf,
    work: Path,
) -> Reconstruction:
    """Triangulate points for a model that has only cameras, of HR views.

    As in SfM, LR views are degraded, and resized to the size of their HR views: `photos` needs `hr`
    copies, and `lr` copies of the degraded views. `work` is an existing folder for temporary files.
    XrgsError if too few points are found.
    """
    folder, order = work / "triangulation", sorted(model.viewmats)
    (folder / masks.MASKS).mkdir(parents=True)
    given = []
    for i in progress(order, "undistorting", "view"):
        lens, kind = model.lenses[i], "lr" if i in degraded else "hr"
        image, mask = photos.undistorted(kind, i, lens.resized(*photos.size(kind, i)))
        file = f"{photos[i].number}.png"
        images.save(folder / file, images.resize(image, lens.width, lens.height), durable=False)
        if mask is not None:
            resized = masks.resized(mask, lens.width, lens.height)
            images.save_mask(masks.copy_mask(folder, file), resized, durable=False)
        name, K = photos[i].name, lens.undistorted().K
        given.append(sfm.SfmImage(file, name, name, K, masked=mask is not None))
    found = sfm.triangulate(given, [model.viewmats[i] for i in order], folder, folder, conf)
    count = len(found.points)
    if count < MIN_POINTS:
        raise XrgsError(
            f"variant.poses has no points, and {count} were found in the photographs with its "
            "poses: are these the poses of these photographs? Points of a .ply can be named as "
            "ply_file_path in a transforms.json"
        )
    note = f"variant.poses has no points: {count} were triangulated from the photographs"
    return replace(
        model,
        points=found.points,
        colors=found.colors,
        observed={i: found.observed[n] for n, i in enumerate(order)},
        report=model.report | found.report | {"notes": [*model.report["notes"], note]},
    )
