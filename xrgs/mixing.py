"""The recipe of a variant, step by step: photographs, split, LR copies, SfM, straightening.

COLMAP is re-run on the mixed-resolution content (paper section 4). With `sfm.lr_images: upsampled`
LR views are brought back to HR size for SfM alone, one camera for all, which registers the small
images several times more accurately; `native` gives SfM the files as they are, a camera a class.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from xrgs import images, sfm
from xrgs.alignment import pose_error
from xrgs.errors import XrgsError
from xrgs.images import Lens
from xrgs.split import Frame, Split, check, frame, split
from xrgs.views import SceneFailed, Variant, View

if TYPE_CHECKING:
    from xrgs.config import VariantConf
    from xrgs.scenes import Scene

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Photos:
    """The readable photographs as HR views in `folder/hr`, one frame for all."""

    names: list[str]
    folder: Path
    original: tuple[int, int]
    frame: Frame
    unreadable: list[str] = field(default_factory=list)

    def file(self, size: str, index: int) -> str:
        """Relative path of a copy; numbered, for COLMAP need not cope with people's file names."""
        return f"{size}/{index:05d}.png"


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
    photos = _high(scene, conf, work)
    parts = split(len(photos.names), conf)
    _low(photos, parts, conf)
    model = sfm.reconstruct(_shots(scene, photos, parts, conf), work, work, conf.sfm)
    _keep_log(work, out)
    report = _report(scene, photos, parts, model)
    _judge(scene, photos, parts, conf, model, report)
    views = _straighten(photos, parts, model, out)
    report["seconds"] = round(time.perf_counter() - start, 1)
    held_out = conf.test_every > 0
    return Variant(
        "", out, scene.name, conf.factor, held_out, views, model.points, model.colors, report
    )


def _high(scene: Scene, conf: VariantConf, work: Path) -> _Photos:
    """Read every photograph, drop what can't be read, shrink and crop the rest to HR views."""
    names: list[str] = []
    unreadable: list[str] = []
    first: tuple[Path, tuple[int, int]] | None = None
    target: Frame | None = None
    photos = None
    for file in tqdm(scene.files, desc="HR views", delay=2, leave=False):
        try:
            photo = images.read(file)
        except images.ImageError as error:
            _log.warning("%s; left out", error)
            unreadable.append(str(error))
            continue
        size = photo.shape[1], photo.shape[0]
        if first is None or target is None:
            first, target = (file, size), frame(*size, conf)
            photos = _Photos(names, work, size, target, unreadable)
        elif size != first[1]:
            a, b = (f"{f} is {s[0]}x{s[1]}" for f, s in (first, (file, size)))
            raise XrgsError(f"images of differing sizes: {a}, {b}; one size a scene is supported")
        shrunk = images.resize(photo, *target.resized)
        left, top = target.corner
        cut = shrunk[top : top + target.height, left : left + target.width]
        images.save(work / "hr" / f"{len(names):05d}.png", cut)
        names.append(file.stem)
    if photos is None or len(names) < 2:
        raise XrgsError(f"scene {scene.name}: {len(names)} readable image(s): {unreadable}")
    return photos


def _low(photos: _Photos, parts: Split, conf: VariantConf) -> None:
    """LR copies in `lr`, and for SfM their enlargements in `up`."""
    width, height = photos.frame.width, photos.frame.height
    for i in tqdm(parts.lr, desc="LR views", delay=2, leave=False):
        high = images.read(photos.folder / photos.file("hr", i))
        low_file = photos.folder / photos.file("lr", i)
        images.save(low_file, images.resize(high, width // conf.factor, height // conf.factor))
        if conf.sfm.lr_images == "upsampled":
            enlarged = images.resize(images.read(low_file), width, height)
            images.save(photos.folder / photos.file("up", i), enlarged)


def _shots(scene: Scene, photos: _Photos, parts: Split, conf: VariantConf) -> list[sfm.Shot]:
    """What SfM sees of every view, with its camera where that is known."""
    native = conf.sfm.lr_images == "native"
    shots = []
    for i, name in enumerate(photos.names):
        low = i in parts.lr
        folder = ("lr" if native else "up") if low else "hr"
        lens = _known_lens(scene.intrinsics, name, photos)
        if lens is None:
            shots.append(sfm.Shot(photos.file(folder, i), folder if native else "all"))
            continue
        if low and native:
            lens = lens.at(lens.width // conf.factor, lens.height // conf.factor)
        shots.append(sfm.Shot(photos.file(folder, i), name, lens.K))
    return shots


def _known_lens(
    intrinsics: Mapping[str, NDArray[np.float64]], name: str, photos: _Photos
) -> Lens | None:
    """The camera of an HR view, from that of its photograph: resized, then cropped."""
    K = intrinsics.get(name)
    if K is None:
        return None
    lens = Lens(*photos.original, K[0, 0], K[1, 1], K[0, 2], K[1, 2]).at(*photos.frame.resized)
    left, top = photos.frame.corner
    width, height = photos.frame.width, photos.frame.height
    return Lens(width, height, lens.fx, lens.fy, lens.cx - left, lens.cy - top)


def _keep_log(work: Path, out: Path) -> None:
    """COLMAP's log files as one; each begins with a name of its own making."""
    parts = sorted(work.glob("colmap-*"))
    text = "".join(part.read_text(encoding="utf-8", errors="replace") for part in parts)
    (out / "colmap.log").write_text(text, encoding="utf-8")


def _report(
    scene: Scene, photos: _Photos, parts: Split, model: sfm.Reconstruction
) -> dict[str, Any]:
    names = photos.names
    found = {names[i]: matrix for i, matrix in model.viewmats.items()}
    lenses = sorted({repr(lens) for lens in model.lenses.values()})
    return model.report | {
        "scene": scene.name,
        "fingerprint": scene.fingerprint,
        "hr_size": [photos.frame.width, photos.frame.height],
        "tests": len(parts.test),
        "hr": [names[i] for i in parts.hr],
        "lr": [names[i] for i in parts.lr],
        "unreadable": photos.unreadable,
        "not_registered": [n for i, n in enumerate(names) if i not in model.viewmats],
        "lenses": lenses,
        "pose_error": pose_error(found, scene.viewmats),
    }


def _judge(
    scene: Scene,
    photos: _Photos,
    parts: Split,
    conf: VariantConf,
    model: sfm.Reconstruction,
    report: dict[str, Any],
) -> None:
    """Raise `SceneFailed` unless enough views are placed to train on and to test."""
    placed = model.viewmats.keys()
    hr, lr = placed & set(parts.hr), placed & set(parts.lr)
    tests = placed & set(parts.test) if conf.test_every else placed
    missing = report["not_registered"]
    summary = f"scene {scene.name} failed: COLMAP placed {len(placed)} of {len(photos.names)} views"
    if missing:
        summary += f" (not {', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''})"
    summary += f" and {len(model.points)} points"
    wanted = conf.sfm.min_registered * len(photos.names)
    if len(placed) < wanted:
        share = conf.sfm.min_registered
        raise SceneFailed(f"{summary}; variant.sfm.min_registered={share} asks for more.", report)
    if len(hr) < 1 or len(hr) + len(lr) < 2 or not tests:
        left = f"{len(hr)} HR, {len(lr)} LR and {len(tests)} test views"
        raise SceneFailed(f"{summary}: {left}; 1 HR, 2 to train on, 1 test are needed.", report)


def _straighten(
    photos: _Photos, parts: Split, model: sfm.Reconstruction, out: Path
) -> tuple[View, ...]:
    """Undistort what is trained on and what is tested on, each at its own size."""
    low = set(parts.lr)
    train = [("train", i, "LR" if i in low else "HR") for i in sorted((*parts.hr, *parts.lr))]
    test = [("test", i, "HR") for i in (parts.test or range(len(photos.names)))]
    todo = [entry for entry in (*train, *test) if entry[1] in model.viewmats]
    views = []
    for part, i, tag in tqdm(todo, desc="undistorting", delay=2, leave=False):
        image = images.read(photos.folder / photos.file(tag.lower(), i))
        height, width = image.shape[:2]
        lens = model.lenses[i].at(width, height)
        file = out / "images" / part / f"{photos.names[i]}.png"
        images.save(file, images.straighten(image, lens))
        K, name = lens.straightened().K, photos.names[i]
        views.append(View(name, file, part, tag, width, height, K, model.viewmats[i]))
    return tuple(sorted(views, key=lambda view: (view.split, view.name)))
