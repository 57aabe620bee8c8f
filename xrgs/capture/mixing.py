"""Makes the content of a variant: HR and LR views, their poses by SfM, and undistorted images.

COLMAP is re-run on the mixed-resolution images (paper section 4). Where the tags depend on depth,
they are known only after SfM, which then gets the photographs as they are.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture import degrade, images, registration, tagging
from xrgs.capture.alignment import pose_error
from xrgs.capture.lens import undistort
from xrgs.capture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.capture.split import Split, check_variant_conf, split_views
from xrgs.capture.views import SceneFailed, Variant, View
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import write_text
from xrgs.safeio.confined import ConfinedPath

if TYPE_CHECKING:
    from xrgs.capture.scenes import Scene
    from xrgs.capture.sfm import Reconstruction
    from xrgs.config import VariantConf


@dataclass(frozen=True)
class _Inputs:
    """The photographs of a variant, and the class of each."""

    scene: Scene
    conf: VariantConf
    photos: PhotoCollection
    split: Split

    @property
    def degraded(self) -> tuple[int, ...]:
        """Indices of the training views that the variant degrades."""
        return () if degrade.resolve_degradation(self.conf) == "none" else self.split.lr


def mix_resolutions(scene: Scene, conf: VariantConf, work: Path, out: ConfinedPath) -> Variant:
    """Make the views, poses and points of a variant.

    Args:
        scene: The photographs.
        conf: The variant's config.
        work: An existing folder for temporary files.
        out: An existing folder for `images/<split>/<view>.png` and `colmap.log`.

    Returns:
        The variant, with an empty id.

    Raises:
        SceneFailed: Too few views are registered.
        XrgsError: The photographs or the config are not usable; the message names what is wrong.
    """
    check_variant_conf(conf)
    start = time.perf_counter()
    photos = prepare_hr_views(scene, conf, work)
    inputs = _Inputs(scene, conf, photos, _split_before_sfm(photos, conf))
    write_degraded(photos, inputs.degraded, conf)
    registered = registration.register(
        photos, inputs.degraded, conf.sfm, work, lambda model: _refusal(inputs, model)
    )
    model = registered.model
    _write_log(work, out)
    report = _sfm_report(inputs, model) | {"attempts": registered.attempts}
    if registered.refused:
        raise SceneFailed(f"scene {scene.name} failed: {registered.refused}", report)
    report |= _pose_report(inputs, model, work)
    depths = tagging.median_depths(model)
    if conf.tags in tagging.DEPTH_POLICIES:
        inputs = replace(inputs, split=_split_by_depth(inputs, model, depths))
        write_degraded(photos, inputs.degraded, conf)
    views = _write_undistorted(inputs, model, depths, out)
    report |= _tags_report(inputs, views)
    report["seconds"] = round(time.perf_counter() - start, 1)
    held_out = conf.test_every > 0
    return Variant(
        "", out, scene.name, conf.factor, held_out, views, model.points, model.colors, report
    )


def _split_before_sfm(photos: PhotoCollection, conf: VariantConf) -> Split:
    """Split the views; where the tags depend on depth, all training views are HR for now."""
    if conf.tags == "megapixels":
        scores = tagging.megapixel_scores([photo.size for photo in photos.all])
        return split_views(len(photos), conf, scores)
    if conf.tags in tagging.DEPTH_POLICIES:
        return split_views(len(photos), replace(conf, hr_fraction=1.0))
    return split_views(len(photos), conf)


def _split_by_depth(inputs: _Inputs, model: Reconstruction, depths: Mapping[int, float]) -> Split:
    lenses = {i: lens.undistorted() for i, lens in model.lenses.items()}
    conf, views = inputs.conf, len(inputs.photos)
    return split_views(views, conf, tagging.depth_scores(conf.tags, views, lenses, depths))


def _refusal(inputs: _Inputs, model: Reconstruction) -> str:
    """Say why too few views are registered to train and to test on; empty where they are enough."""
    split, names, conf = inputs.split, inputs.photos.names, inputs.conf
    registered = model.viewmats.keys()
    hr, lr = registered & set(split.hr), registered & set(split.lr)
    tests = registered & set(split.test) if conf.test_every else registered
    missing = [name for i, name in enumerate(names) if i not in registered]
    summary = f"COLMAP registered {len(registered)} of {len(names)} views"
    if missing:
        summary += f" (not {', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''})"
    summary += f" and found {len(model.points)} points"
    fraction = conf.sfm.min_registered
    if len(registered) < fraction * len(names):
        return f"{summary}; variant.sfm.min_registered={fraction} requires more."
    class_lost = (split.hr and not hr) or (split.lr and not lr)
    if class_lost or len(hr) + len(lr) < 2 or not tests:
        counts = f"{len(hr)} HR, {len(lr)} LR and {len(tests)} test views"
        return f"{summary}: {counts}; at least one of each class and two training views are needed."
    return ""


def _write_log(work: Path, out: ConfinedPath) -> None:
    """Join COLMAP's log files; each of them begins with its own name."""
    files = sorted(work.rglob("colmap-*"))
    text = "".join(file.read_text(encoding="utf-8", errors="replace") for file in files)
    write_text(out / "colmap.log", text)


def _sfm_report(inputs: _Inputs, model: Reconstruction) -> dict[str, Any]:
    """Report the photographs, and how SfM went."""
    scene, photos = inputs.scene, inputs.photos
    sizes = Counter(f"{photo.hr.width}x{photo.hr.height}" for photo in photos.all)
    return model.report | {
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "hr_sizes": dict(sizes),
        "cameras": len({photo.camera for photo in photos.all}),
        "unreadable": list(photos.unreadable),
        "not_registered": [n for i, n in enumerate(photos.names) if i not in model.viewmats],
        "lenses": sorted({repr(lens) for lens in model.lenses.values()}),
    }


def _pose_report(inputs: _Inputs, model: Reconstruction, work: Path) -> dict[str, Any]:
    """Compare the poses with exact ones, or else with those of the undegraded photographs."""
    photos, exact = inputs.photos, inputs.scene.viewmats
    estimated = {photos.names[i]: matrix for i, matrix in model.viewmats.items()}
    if exact:
        return {"pose_error": pose_error(estimated, exact), "pose_error_against": "exact cameras"}
    if not inputs.conf.sfm.reference or not inputs.degraded:
        return {"pose_error": {}, "pose_error_against": ""}
    start = time.perf_counter()
    reference = registration.reconstruct_undegraded(photos, inputs.conf.sfm, work)
    exact = {photos.names[i]: matrix for i, matrix in reference.viewmats.items()}
    keys = ("registered", "points", "reprojection_error_px")
    results = {key: reference.report[key] for key in keys if key in reference.report}
    seconds = round(time.perf_counter() - start, 1)
    return {
        "pose_error": pose_error(estimated, exact),
        "pose_error_against": "SfM of the undegraded photographs",
        "reference": results | {"seconds": seconds},
    }


def _tags_report(inputs: _Inputs, views: tuple[View, ...]) -> dict[str, Any]:
    """Report the class of each view, and minimum, median and maximum of rho per class."""
    names, split = inputs.photos.names, inputs.split
    rates = {
        tag: [view.rho for view in views if (view.split, view.tag) == ("train", tag)]
        for tag in ("HR", "LR")
    }
    return {
        "tags": inputs.conf.tags,
        "degradation": degrade.resolve_degradation(inputs.conf),
        "tests": len(split.test),
        "hr": [names[i] for i in split.hr],
        "lr": [names[i] for i in split.lr],
        "rho": {
            tag: [min(values), float(np.median(values)), max(values)]
            for tag, values in rates.items()
            if values
        },
    }


def _write_undistorted(
    inputs: _Inputs, model: Reconstruction, depths: Mapping[int, float], out: ConfinedPath
) -> tuple[View, ...]:
    """Undistort every registered view at its own size, and write it."""
    photos, split = inputs.photos, inputs.split
    degraded, low = set(inputs.degraded), set(split.lr)
    train = [("train", i, "LR" if i in low else "HR") for i in sorted((*split.hr, *split.lr))]
    test = [("test", i, "HR") for i in (split.test or range(len(photos)))]
    original = [("original", i, "HR") for i in sorted(degraded)]
    registered = [entry for entry in (*train, *test, *original) if entry[1] in model.viewmats]
    views, rates = [], []
    for part, i, tag in progress(registered, "undistorting", "view"):
        image = photos.read("lr" if part == "train" and i in degraded else "hr", i)
        height, width = image.shape[:2]
        lens = model.lenses[i].resized(width, height)
        file = out / "images" / part / f"{photos.names[i]}.png"
        images.save(file, undistort(image, lens), durable=False)  # `freeze` syncs all
        K, name = lens.undistorted().K, photos.names[i]
        views.append(View(name, file, part, tag, width, height, K, model.viewmats[i], 1.0))
        rates.append(tagging.sampling_rate(K, depths[i]))
    rhos = tagging.relative_to_largest(rates)
    views = [replace(view, rho=rho) for view, rho in zip(views, rhos, strict=True)]
    return tuple(sorted(views, key=lambda view: (view.split, view.name)))
