"""Triangulates points for poses without points, as in the scenes of Blender and instant-ngp."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.mixture import sfm
from xrgs.mixture.poses.given import MIN_POINTS
from xrgs.photos import images, masks
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.config import SfmConf
    from xrgs.mixture.photographs import PhotoCollection


def with_points(
    model: sfm.Reconstruction,
    photos: PhotoCollection,
    degraded: Collection[int],
    conf: SfmConf,
    work: Path,
) -> sfm.Reconstruction:
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
