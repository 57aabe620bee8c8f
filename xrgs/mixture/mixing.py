"""Makes the content of a variant: HR and LR views, their poses by SfM, and undistorted images.

COLMAP is run anew on the mixed-resolution images (paper, section 4). If the tags depend on depth,
they are known only after SfM, which then gets the undegraded photographs.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from xrgs.config import VariantConf
from xrgs.mixture import poses, sampling_rate, sfm_retries
from xrgs.mixture.blur import blur_notes, lr_blur
from xrgs.mixture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.mixture.pose_error import pose_error
from xrgs.mixture.sfm_retries import Attempt, Registration
from xrgs.mixture.split import (
    Split,
    check_variant_conf,
    shortage,
    split_before_sfm,
    split_by_score,
    split_notes,
)
from xrgs.mixture.tags import POLICIES
from xrgs.mixture.views import Reconstruction, SceneFailed, Variant, View
from xrgs.photos import images
from xrgs.photos.lens import Lens
from xrgs.photos.scenes import Scene
from xrgs.runtime.machine import on_threads
from xrgs.runtime.progress import progress
from xrgs.runtime.text import listed
from xrgs.safeio.atomic import write_text

#: Least ratio of the median sampling rates of HR and LR views without a note; our choice. The paper
#: has a ratio of 5.
_LEAST_RATIO = 1.25
#: Largest number of points at which views are compared, to limit the memory for a thousand views.
_MOST_COMPARED = 10_000


@dataclass(frozen=True)
class _Inputs:
    """The photographs of a variant, and the tag of each."""

    scene: Scene
    conf: VariantConf
    photos: PhotoCollection
    split: Split

    @property
    def degraded(self) -> tuple[int, ...]:
        """Indices of the training views to degrade."""
        return () if resolve_degradation(self.conf) == "none" else self.split.lr


def mix_resolutions(scene: Scene, conf: VariantConf, work: Path, out: Path) -> Variant:
    """Make the views, poses and points of a variant; its id is still empty.

    Args:
        scene: The photographs.
        conf: The variant's config.
        work: An existing folder for temporary files.
        out: A folder with an empty folder `images`, for `images/<split>/<view>.png` and
            `colmap.log`.

    Raises:
        SceneFailed: Too few views are registered.
        XrgsError: The photographs or the config are not usable; the message says why.
    """
    check_variant_conf(conf)
    start = time.perf_counter()
    scene = poses.with_masks(scene, conf.poses)
    photos = prepare_hr_views(scene, conf, work, for_sfm=conf.poses is None)
    sizes = [photo.size for photo in photos.all]
    inputs = _Inputs(scene, conf, photos, split_before_sfm(photos.names, sizes, conf))
    registered = _register(inputs, work)
    model = registered.model
    _write_log(work, out)
    report = _sfm_report(inputs, model) | {"attempts": registered.attempts}
    if registered.refused:
        raise _failure(inputs, registered, report, work)
    report |= _pose_report(inputs, registered, work)
    depths = sampling_rate.median_depths(model)
    if conf.tags in POLICIES and POLICIES[conf.tags].needs_depth:
        inputs = replace(inputs, split=_split_by_depth(photos, conf, model, depths))
    write_degraded(photos, inputs.degraded, conf)
    views, hidden = _write_undistorted(inputs, model, depths, out)
    views = _with_needs(inputs, views, model.points)
    tags, masked = _tags_report(inputs, views), _mask_report(views)
    blurred = _blur_report(conf, views)
    notes = [*report["notes"], *tags["notes"], *hidden, *masked["notes"], *blurred["notes"]]
    report |= tags | masked | blurred | {"notes": notes}
    report["seconds"] = round(time.perf_counter() - start, 1)
    held_out = bool(inputs.split.test)
    points, colors = model.points, model.colors
    return Variant(
        "", out, scene.name, conf.factor, held_out, views, points, colors, report, model.world
    )


def _register(inputs: _Inputs, work: Path) -> Registration:
    """Run SfM, or read the user's poses."""
    photos, conf = inputs.photos, inputs.conf
    if conf.poses is not None:
        model = poses.read_poses(conf.poses, photos)
        if not len(model.points):
            write_degraded(photos, inputs.degraded, conf)
            model = sfm_retries.with_points(model, photos, inputs.degraded, conf.sfm, work)
        return Registration(model, _refusal(inputs, model), Attempt("given", conf.sfm), [])
    write_degraded(photos, inputs.degraded, conf, "sfm_lr")
    return sfm_retries.register(
        photos, inputs.degraded, conf.sfm, work, lambda model: _refusal(inputs, model)
    )


def _split_by_depth(
    photos: PhotoCollection, conf: VariantConf, model: Reconstruction, depths: Mapping[int, float]
) -> Split:
    """Split the views by the scores of `variant.tags`; views without a pose are LR."""
    measures = [
        replace(measured, K=model.lenses[i].undistorted().K, depth=depths.get(i, measured.depth))
        if i in model.lenses
        else measured
        for i, measured in enumerate(sampling_rate.not_placed(photo.size) for photo in photos.all)
    ]
    return split_by_score(photos.names, measures, conf)


def _refusal(inputs: _Inputs, model: Reconstruction) -> str:
    """Say why too few views are registered for training and test; empty if they are enough."""
    names, conf = inputs.photos.names, inputs.conf
    missing = [name for i, name in enumerate(names) if i not in model.viewmats]
    source = "" if conf.poses is None else "variant.poses: "
    summary = f"{source}{_placed(model, names)}, {len(model.points)} points"
    if missing:
        summary += f"; not placed: {listed(missing)}"
    fraction = conf.sfm.min_registered
    if len(model.viewmats) < fraction * len(names):
        return f"{summary}; variant.sfm.min_registered={fraction} requires more"
    lacking = shortage(inputs.split, model.viewmats.keys(), conf)
    return f"{summary}; {lacking}" if lacking else ""


def _placed(model: Reconstruction, names: Sequence[str]) -> str:
    return f"{len(model.viewmats)} of {len(names)} photographs are placed"


def _failure(
    inputs: _Inputs, registered: Registration, report: dict[str, Any], work: Path
) -> SceneFailed:
    """Describe the failure: photographs that are not placed, SfM without degradation, advice."""
    conf, photos, model = inputs.conf, inputs.photos, registered.model
    said = [registered.refused]
    undegraded = None
    if conf.poses is None and inputs.degraded:
        undegraded = sfm_retries.reconstruct_undegraded(photos, registered.attempt, work)
        report = report | {"reference": _results(undegraded)}
        said.append(f"undegraded, {_placed(undegraded, photos.names)}")
    advice = ", ".join(_advice(inputs, model, undegraded))
    text = f"scene {inputs.scene.name} failed: {'; '.join(said)}. To try: {advice}."
    return SceneFailed(text, report)


def _advice(
    inputs: _Inputs, model: Reconstruction, undegraded: Reconstruction | None
) -> Iterator[str]:
    """Yield settings that may place more photographs, or accept the placed ones."""
    conf, placed = inputs.conf, len(model.viewmats)
    if conf.poses is None:
        if undegraded is not None and len(undegraded.viewmats) > placed and conf.factor > 2:
            yield f"variant.factor={math.ceil(conf.factor / 2)}"
        largest = max(max(photo.size) for photo in inputs.photos.all)
        if 0 < conf.sfm.long_side < largest:
            yield f"variant.sfm.long_side=0 (the photographs have {largest} px)"
        parts = model.report["models"]
        if len(parts) > 1:
            yield f"photographs between the separate parts of {' and '.join(map(str, parts))}"
        else:
            yield "photographs that overlap more"
        yield "variant.poses=FOLDER with cameras of another program"
    else:
        yield "poses of the others"
    if placed and not shortage(inputs.split, model.viewmats.keys(), conf):
        share = math.floor(100 * placed / len(inputs.photos)) / 100
        yield f"variant.sfm.min_registered={share} to go on without the others"


def _write_log(work: Path, out: Path) -> None:
    """Concatenate COLMAP's log files, whose first lines have their names."""
    files = sorted(work.rglob("colmap-*"))
    text = "".join(file.read_text(encoding="utf-8", errors="replace") for file in files)
    write_text(out / "colmap.log", text)


def _sfm_report(inputs: _Inputs, model: Reconstruction) -> dict[str, Any]:
    """Report the photographs and the results of SfM."""
    scene, photos = inputs.scene, inputs.photos
    sizes = Counter(f"{photo.hr.width}x{photo.hr.height}" for photo in photos.all)
    return model.report | {
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "hr_sizes": dict(sizes),
        "cameras": len({photo.camera for photo in photos.all}),
        "notes": [*scene.notes, *photos.notes, *model.report.get("notes", ())],
        "not_registered": [n for i, n in enumerate(photos.names) if i not in model.viewmats],
        "lenses": _lens_report(photos, model),
    }


def _lens_report(photos: PhotoCollection, model: Reconstruction) -> list[dict[str, Any]]:
    """Report each camera once, with the names of its photographs."""
    names: dict[Lens, list[str]] = {}
    for i, lens in sorted(model.lenses.items()):
        names.setdefault(lens, []).append(photos.names[i])
    return [{"lens": asdict(lens), "views": views} for lens, views in names.items()]


def _pose_report(inputs: _Inputs, registered: Registration, work: Path) -> dict[str, Any]:
    """Compare the poses with exact ones, or if unknown, with SfM of the undegraded photographs."""
    photos, exact = inputs.photos, inputs.scene.viewmats
    estimated = {photos.names[i]: matrix for i, matrix in registered.model.viewmats.items()}
    if exact:
        return {"pose_error": pose_error(estimated, exact), "pose_error_against": "exact cameras"}
    given = inputs.conf.poses is not None
    if given or not inputs.conf.sfm.reference or not inputs.degraded:
        return {"pose_error": {}, "pose_error_against": ""}
    start = time.perf_counter()
    attempt = replace(registered.attempt, conf=inputs.conf.sfm)
    reference = sfm_retries.reconstruct_undegraded(photos, attempt, work)
    exact = {photos.names[i]: matrix for i, matrix in reference.viewmats.items()}
    seconds = round(time.perf_counter() - start, 1)
    return {
        "pose_error": pose_error(estimated, exact),
        "pose_error_against": "SfM of the undegraded photographs",
        "reference": _results(reference) | {"seconds": seconds},
    }


def _results(reference: Reconstruction) -> dict[str, Any]:
    keys = ("registered", "points", "reprojection_error_px")
    return {key: reference.report[key] for key in keys if key in reference.report}


def _tags_report(inputs: _Inputs, views: tuple[View, ...]) -> dict[str, Any]:
    """Report the tag of each view, and minimum, median and maximum of rho for each tag."""
    names, split = inputs.photos.names, inputs.split
    rates = {
        tag: [view.sampling_rate for view in views if (view.split, view.tag) == ("train", tag)]
        for tag in ("HR", "LR")
    }
    return {
        "notes": [
            *split_notes(split, inputs.conf),
            *_class_notes(inputs, rates),
            *_need_notes(inputs, views),
        ],
        "tags": inputs.conf.tags,
        "degradation": resolve_degradation(inputs.conf),
        "tests": len(split.test),
        "hr": [names[i] for i in split.hr],
        "lr": [names[i] for i in split.lr],
        "rho": {
            tag: [min(values), float(np.median(values)), max(values)]
            for tag, values in rates.items()
            if values
        },
    }


def _class_notes(inputs: _Inputs, rates: Mapping[str, list[float]]) -> list[str]:
    """Return a note if undegraded HR and LR photographs have nearly the same sampling rate."""
    if inputs.degraded or not rates["HR"] or not rates["LR"]:
        return []
    ratio = float(np.median(rates["HR"]) / np.median(rates["LR"]))
    if ratio >= _LEAST_RATIO:
        return []
    both = rates["HR"] + rates["LR"]
    return [
        f"the split by variant.tags={inputs.conf.tags} is meaningless: rho is {min(both):.3f} to "
        f"{max(both):.3f}, and its median in HR views {ratio:.2f} times that in LR views, so that "
        "all show the scene at about one resolution; variant.tags=flag makes a mixture"
    ]


def _with_needs(
    inputs: _Inputs, views: tuple[View, ...], points: sampling_rate.Array
) -> tuple[View, ...]:
    """Return the views with their `View.supersampling`."""
    zooms = resolve_degradation(inputs.conf) == "digital_zoom"
    points = points[:: math.ceil(len(points) / _MOST_COMPARED)]
    rates = []
    for view in views:
        size = (view.width, view.height)
        used = None if view.mask is None else images.read_mask(view.mask, size)
        at_points = sampling_rate.point_rates(points, view.viewmat, view.K, size, used)
        degraded = view.split == "train" and view.tag == "LR"
        # The resolution after a digital zoom is lower than the number of px.
        rates.append(at_points / inputs.conf.factor if zooms and degraded else at_points)
    trained = np.array([view.split == "train" for view in views])
    needs = sampling_rate.needed_factors(np.stack(rates), trained)
    return tuple(replace(view, supersampling=need) for view, need in zip(views, needs, strict=True))


def _need_notes(inputs: _Inputs, views: tuple[View, ...]) -> list[str]:
    """Return a note on the supersampled training views, unless they are the degraded ones."""
    training = [view for view in views if view.split == "train"]
    larger = [round(view.supersampling) > 1 for view in training]
    if inputs.degraded and larger == [view.tag == "LR" for view in training]:
        return []
    largest = max(view.supersampling for view in training)
    which = f"{sum(larger)} of {len(training)}" if any(larger) else "none"
    return [
        f"sampling rates of training views differ by {largest:.1f} where they show the same points:"
        f" components.supersampled, where it is on, renders {which} of the views larger"
    ]


def _mask_report(views: tuple[View, ...]) -> dict[str, Any]:
    """Report the fraction of masked pixels for each tag."""
    shares = {}
    for kind, split, tag in (("HR", "train", "HR"), ("LR", "train", "LR"), ("test", "test", "HR")):
        of_kind = [view for view in views if (view.split, view.tag) == (split, tag)]
        hidden = [
            np.count_nonzero(~images.read_mask(view.mask, (view.width, view.height)))
            for view in of_kind
            if view.mask is not None
        ]
        if hidden:
            pixels = sum(view.width * view.height for view in of_kind)
            shares[kind] = float(sum(hidden) / pixels)
    said = ", ".join(f"{100 * share:.3g} % of {kind} views" for kind, share in shares.items())
    return {
        "masked": shares,
        "notes": [f"masks hide so much of the pixels: {said}"] if said else [],
    }


def _blur_report(conf: VariantConf, views: tuple[View, ...]) -> dict[str, Any]:
    """Report the blur of LR views, and whether they are blurrier than their pixels."""
    blur, degradation = lr_blur(views), DEGRADATIONS.get(resolve_degradation(conf))
    # A degradation that keeps the size of views blurs them on purpose.
    expected = degradation is not None and not degradation.smaller
    return {"lr_blur": blur, "notes": [] if expected else blur_notes(blur)}


def _write_undistorted(
    inputs: _Inputs, model: Reconstruction, depths: Mapping[int, float], out: Path
) -> tuple[tuple[View, ...], list[str]]:
    """Undistort and write every registered view at its size; return views and notes."""
    photos, split = inputs.photos, inputs.split
    degraded, low = set(inputs.degraded), set(split.lr)
    train = [("train", i, "LR" if i in low else "HR") for i in sorted((*split.hr, *split.lr))]
    test = [("test", i, "HR") for i in (split.test or range(len(photos)))]
    original = [("original", i, "HR") for i in sorted(degraded)]
    registered = [entry for entry in (*train, *test, *original) if entry[1] in model.viewmats]

    def write(entry: tuple[str, int, str]) -> View | None:
        part, i, tag = entry
        kind, name = "lr" if part == "train" and i in degraded else "hr", photos.names[i]
        width, height = photos.size(kind, i)
        lens = model.lenses[i].resized(width, height)
        image, used = photos.undistorted(kind, i, lens)
        if used is not None and not used.any():
            return None
        file = out / "images" / part / f"{name}.png"
        mask = None if used is None else out / "images" / f"{part}-masks" / f"{name}.png"
        images.save(file, image, durable=False)  # `freeze` syncs all
        if used is not None and mask is not None:
            images.save_mask(mask, used, durable=False)
        K = lens.undistorted().K
        return View(name, file, part, tag, width, height, K, model.viewmats[i], 1.0, mask)

    written = progress(on_threads(write, registered), "undistorting", "view", len(registered))
    views, rates, hidden = [], [], []
    for (part, i, _), view in zip(registered, written, strict=True):
        if view is None:
            hidden.append(f"{photos.names[i]} ({part})")
        else:
            views.append(view)
            rates.append(sampling_rate.sampling_rate(view.K, depths[i]))
    rhos = sampling_rate.relative_to_largest(rates)
    notes = [f"views left out, whose masks leave no pixel: {listed(hidden)}"] if hidden else []
    views = [replace(view, sampling_rate=rho) for view, rho in zip(views, rhos, strict=True)]
    return tuple(sorted(views, key=lambda view: (view.split, view.name))), notes
