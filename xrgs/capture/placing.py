"""Which images SfM is given, and what is tried where it places too few of them.

With `sfm.lr_images: upsampled` downsampled views are brought back to HR size for SfM alone, one
camera for both sizes, which places the small images several times more accurately; `native` gives
SfM the files as they are, a camera of its own for the small ones.

The recipes, in order (`sfm.fallbacks`); the first that places enough is kept:

1. `configured`: `variant.sfm` as it is.
2. `finer`: twice the features, sought at twice the resolution.
3. `relaxed`: the same features, a first pair of a quarter of the angle, half the inliers a view.
4. `native` (or `upsampled`, where native was configured): LR images the other way, and relaxed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from xrgs.capture import sfm

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.capture.photographs import Photographs
    from xrgs.config import SfmConf

_log = logging.getLogger(__name__)

#: COLMAP's own floor of points that tell a pose.
_LEAST_INLIERS = 6
_TOLD = ("registered", "models", "points", "reprojection_error_px")
_RECIPE = ("lr_images", "first_octave", "max_num_features", "init_min_tri_angle", "min_inliers")


@dataclass(frozen=True)
class Placed:
    """What was kept, and everything that was tried."""

    model: sfm.Reconstruction
    refused: str
    """Why even the best attempt is not good enough; empty where one is."""
    attempts: list[dict[str, Any]]


def place(
    photos: Photographs,
    degraded: Collection[int],
    conf: SfmConf,
    work: Path,
    verdict: Callable[[sfm.Reconstruction], str],
) -> Placed:
    """Run SfM on the mixed images, recipe after recipe until `verdict` has nothing against one.

    Args:
        photos: HR views, with their degraded copies beside them.
        degraded: Indices of the views that SfM is to see degraded.
        conf: The first recipe.
        work: An existing folder for SfM's own files.
        verdict: Why a reconstruction is refused; empty to accept it.

    Returns:
        The first accepted, or of those refused the one that placed most views.
    """
    best: tuple[sfm.Reconstruction, str] | None = None
    attempts: list[dict[str, Any]] = []
    smaller = any(_is_smaller(photos, i) for i in degraded)
    for name, home, recipe in recipes(conf, len(photos), smaller=smaller):
        start = time.perf_counter()
        (work / home).mkdir(exist_ok=True)
        given = shots(photos, degraded, recipe)
        model = sfm.reconstruct(given, photos.folder, work / home, recipe)
        refused = verdict(model)
        seconds = round(time.perf_counter() - start, 1)
        told = {key: model.report[key] for key in (*_RECIPE, *_TOLD) if key in model.report}
        attempts.append({"attempt": name, "refused": refused, "seconds": seconds} | told)
        if best is None or len(model.viewmats) > len(best[0].viewmats) or not refused:
            best = model, refused
        if not refused:
            break
        _log.warning("SfM, recipe %s: %s", name, refused)
    if best is None:
        raise RuntimeError("there is always a first recipe")
    return Placed(*best, attempts)


def recipes(conf: SfmConf, images: int, *, smaller: bool) -> Iterator[tuple[str, str, SfmConf]]:
    """Name, work folder and config of each attempt; those of one folder share their features.

    Args:
        conf: The first of them, and whether there are others.
        images: How many images there are.
        smaller: Whether any is smaller than its HR view, so that it can be given either way.
    """
    yield "configured", "sfm", conf
    if not conf.fallbacks:
        return
    features = 2 * sfm.features_for(images, conf.max_num_features)
    finer = replace(conf, max_num_features=features, first_octave=-1)
    yield "finer", "sfm-finer", finer
    relaxed = replace(
        finer,
        init_min_tri_angle=conf.init_min_tri_angle / 4,
        min_inliers=max(_LEAST_INLIERS, conf.min_inliers // 2),
    )
    yield "relaxed", "sfm-finer", relaxed
    if smaller:
        other = "native" if conf.lr_images == "upsampled" else "upsampled"
        yield other, f"sfm-{other}", replace(relaxed, lr_images=other)


def shots(photos: Photographs, degraded: Collection[int], conf: SfmConf) -> list[sfm.Shot]:
    """What SfM sees of every view, with its camera where that is known."""
    given = []
    for i, photo in enumerate(photos.all):
        kind, camera, lens = "hr", photo.camera, photo.lens
        if i in degraded:
            kind = "lr"
            if _is_smaller(photos, i) and conf.lr_images == "upsampled":
                kind = "up"
                photos.enlarge(i)
            elif _is_smaller(photos, i):
                camera = f"{camera} lr"
                lens = lens and lens.at(*photos.size("lr", i))
        name = photo.name if lens else camera
        given.append(sfm.Shot(photos.file(kind, i), name, lens.K if lens else None))
    return given


def _is_smaller(photos: Photographs, index: int) -> bool:
    frame = photos[index].frame
    return photos.size("lr", index) != (frame.width, frame.height)


def reference(photos: Photographs, conf: SfmConf, work: Path) -> sfm.Reconstruction:
    """SfM of the undegraded photographs, by the configured recipe alone: what was to be had."""
    (work / "sfm-reference").mkdir()
    return sfm.reconstruct(shots(photos, (), conf), photos.folder, work / "sfm-reference", conf)
