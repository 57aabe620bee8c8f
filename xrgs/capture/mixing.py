"""The recipe of a variant, step by step: photographs, tags, LR copies, SfM, straightening.

COLMAP is re-run on the mixed-resolution content (paper section 4). Where the tags follow from
depth they are only known after it: then SfM sees the photographs as they are.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.capture import degrade, images, placing, tagging
from xrgs.capture.alignment import pose_error
from xrgs.capture.photographs import Photographs, prepare, write_degraded
from xrgs.capture.split import Split, check, split
from xrgs.capture.views import SceneFailed, Variant, View
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from xrgs.capture.scenes import Scene
    from xrgs.capture.sfm import Reconstruction
    from xrgs.config import VariantConf


@dataclass(frozen=True)
class _Mixture:
    """What is being mixed, and how."""

    scene: Scene
    conf: VariantConf
    photos: Photographs
    parts: Split

    @property
    def degraded(self) -> tuple[int, ...]:
        """Indices of the views that are trained on with less in them than was taken."""
        return () if degrade.kind(self.conf) == "none" else self.parts.lr


def mix(scene: Scene, conf: VariantConf, work: Path, out: Path) -> Variant:
    """Everything of a variant but its id: images in `out`, SfM's log beside them.

    Args:
        scene: The photographs.
        conf: What to make of them.
        work: An existing folder for what is not kept.
        out: An existing folder for `images/<split>/<view>.png` and `colmap.log`.

    Raises:
        SceneFailed: too few views are placed.
        XrgsError: the photographs or the config are not usable.
    """
    check(conf)
    start = time.perf_counter()
    photos = prepare(scene, conf, work)
    mixture = _Mixture(scene, conf, photos, _tags_before(photos, conf))
    write_degraded(photos, mixture.degraded, conf)
    placed = placing.place(
        photos, mixture.degraded, conf.sfm, work, lambda model: _refusal(mixture, model)
    )
    model = placed.model
    _keep_log(work, out)
    report = _report(mixture, model) | {"attempts": placed.attempts}
    if placed.refused:
        raise SceneFailed(f"scene {scene.name} failed: {placed.refused}", report)
    report |= _pose_error(mixture, model, work)
    depth = tagging.depths(model)
    if conf.tags in tagging.NEED_DEPTH:
        mixture = replace(mixture, parts=_tags_after(mixture, model, depth))
        write_degraded(photos, mixture.degraded, conf)
    views = _straighten(mixture, model, depth, out)
    report |= _tags_report(mixture, views)
    report["seconds"] = round(time.perf_counter() - start, 1)
    held_out = conf.test_every > 0
    return Variant(
        "", out, scene.name, conf.factor, held_out, views, model.points, model.colors, report
    )


def _tags_before(photos: Photographs, conf: VariantConf) -> Split:
    """HR and LR as far as the photographs alone tell; where depth decides, all HR for now."""
    if conf.tags == "megapixels":
        return split(len(photos), conf, tagging.megapixels([p.size for p in photos.all]))
    if conf.tags in tagging.NEED_DEPTH:
        return split(len(photos), replace(conf, hr_fraction=1.0))
    return split(len(photos), conf)


def _tags_after(mixture: _Mixture, model: Reconstruction, depth: Mapping[int, float]) -> Split:
    lenses = {i: lens.straightened() for i, lens in model.lenses.items()}
    conf, views = mixture.conf, len(mixture.photos)
    return split(views, conf, tagging.by_depth(conf.tags, views, lenses, depth))


def _refusal(mixture: _Mixture, model: Reconstruction) -> str:
    """Why too few views are placed to train on and to test; empty where they are enough."""
    parts, names, conf = mixture.parts, mixture.photos.names, mixture.conf
    placed = model.viewmats.keys()
    hr, lr = placed & set(parts.hr), placed & set(parts.lr)
    tests = placed & set(parts.test) if conf.test_every else placed
    missing = [name for i, name in enumerate(names) if i not in placed]
    summary = f"COLMAP placed {len(placed)} of {len(names)} views"
    if missing:
        summary += f" (not {', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''})"
    summary += f" and {len(model.points)} points"
    if len(placed) < conf.sfm.min_registered * len(names):
        share = conf.sfm.min_registered
        return f"{summary}; variant.sfm.min_registered={share} asks for more."
    lost = (parts.hr and not hr) or (parts.lr and not lr)
    if lost or len(hr) + len(lr) < 2 or not tests:
        left = f"{len(hr)} HR, {len(lr)} LR and {len(tests)} test views"
        return f"{summary}: {left}; 1 of each, 2 to train on are needed."
    return ""


def _keep_log(work: Path, out: Path) -> None:
    """COLMAP's log files as one; each begins with a name of its own making."""
    parts = sorted(work.rglob("colmap-*"))
    text = "".join(part.read_text(encoding="utf-8", errors="replace") for part in parts)
    (out / "colmap.log").write_text(text, encoding="utf-8")


def _report(mixture: _Mixture, model: Reconstruction) -> dict[str, Any]:
    """What is known before the tags are: the photographs, and how SfM went."""
    scene, photos = mixture.scene, mixture.photos
    sizes = Counter(f"{p.frame.width}x{p.frame.height}" for p in photos.all)
    return model.report | {
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "hr_sizes": dict(sizes),
        "cameras": len({photo.camera for photo in photos.all}),
        "unreadable": list(photos.unreadable),
        "not_registered": [n for i, n in enumerate(photos.names) if i not in model.viewmats],
        "lenses": sorted({repr(lens) for lens in model.lenses.values()}),
    }


def _pose_error(mixture: _Mixture, model: Reconstruction, work: Path) -> dict[str, Any]:
    """How far the poses are from exact ones, or else from those of the undegraded photographs."""
    photos, exact = mixture.photos, mixture.scene.viewmats
    found = {photos.names[i]: matrix for i, matrix in model.viewmats.items()}
    if exact:
        return {"pose_error": pose_error(found, exact), "pose_error_against": "exact cameras"}
    if not mixture.conf.sfm.reference or not mixture.degraded:
        return {"pose_error": {}, "pose_error_against": ""}
    start = time.perf_counter()
    best = placing.reference(photos, mixture.conf.sfm, work)
    exact = {photos.names[i]: matrix for i, matrix in best.viewmats.items()}
    told = ("registered", "points", "reprojection_error_px")
    seconds = round(time.perf_counter() - start, 1)
    return {
        "pose_error": pose_error(found, exact),
        "pose_error_against": "SfM of the undegraded photographs",
        "reference": {k: best.report[k] for k in told if k in best.report} | {"seconds": seconds},
    }


def _tags_report(mixture: _Mixture, views: tuple[View, ...]) -> dict[str, Any]:
    """Who is what, and how finely each class samples the scene."""
    names, parts = mixture.photos.names, mixture.parts
    rates = {
        tag: [view.rho for view in views if (view.split, view.tag) == ("train", tag)]
        for tag in ("HR", "LR")
    }
    return {
        "tags": mixture.conf.tags,
        "degradation": degrade.kind(mixture.conf),
        "tests": len(parts.test),
        "hr": [names[i] for i in parts.hr],
        "lr": [names[i] for i in parts.lr],
        "rho": {
            tag: [min(found), float(np.median(found)), max(found)]
            for tag, found in rates.items()
            if found
        },
    }


def _straighten(
    mixture: _Mixture, model: Reconstruction, depth: Mapping[int, float], out: Path
) -> tuple[View, ...]:
    """Undistort what is trained on and what is tested on, each at its own size."""
    photos, parts = mixture.photos, mixture.parts
    degraded, low = set(mixture.degraded), set(parts.lr)
    train = [("train", i, "LR" if i in low else "HR") for i in sorted((*parts.hr, *parts.lr))]
    test = [("test", i, "HR") for i in (parts.test or range(len(photos)))]
    original = [("original", i, "HR") for i in sorted(degraded)]
    todo = [entry for entry in (*train, *test, *original) if entry[1] in model.viewmats]
    views, rates = [], []
    for part, i, tag in progress(todo, "undistorting", "view"):
        image = photos.read("lr" if part == "train" and i in degraded else "hr", i)
        height, width = image.shape[:2]
        lens = model.lenses[i].at(width, height)
        file = out / "images" / part / f"{photos.names[i]}.png"
        images.save(file, images.straighten(image, lens))
        K, name = lens.straightened().K, photos.names[i]
        views.append(View(name, file, part, tag, width, height, K, model.viewmats[i], 1.0))
        rates.append(tagging.rate(K, depth[i]))
    views = [replace(v, rho=rho) for v, rho in zip(views, tagging.of_best(rates), strict=True)]
    return tuple(sorted(views, key=lambda view: (view.split, view.name)))
