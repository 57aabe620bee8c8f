"""Finds points where poses are given without any, as in the scenes of Blender and instant-ngp."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING

from xrgs.capture import images, sfm
from xrgs.capture.lens import undistort
from xrgs.capture.poses.given import MIN_POINTS
from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.capture.photographs import PhotoCollection
    from xrgs.config import SfmConf


def with_points(
    model: sfm.Reconstruction,
    photos: PhotoCollection,
    degraded: Collection[int],
    conf: SfmConf,
    work: Path,
) -> sfm.Reconstruction:
    """Triangulate the points of a model that has cameras alone.

    As SfM does, it sees the degraded views, resized to the size of their HR views.

    Args:
        model: Cameras and poses of HR views.
        photos: The photographs, with their `hr` copies and the `lr` copies of the degraded ones.
        degraded: Indices of the views that are degraded.
        conf: The settings of features.
        work: An existing folder for temporary files.

    Raises:
        XrgsError: Too few points are found.
    """
    folder, order = work / "triangulation", sorted(model.viewmats)
    folder.mkdir()
    given = []
    for i in progress(order, "undistorting", "view"):
        lens = model.lenses[i]
        image = photos.read("lr" if i in degraded else "hr", i)
        image = undistort(images.resize(image, lens.width, lens.height), lens)
        file = f"{photos[i].number}.png"
        images.save(folder / file, image, durable=False)
        given.append(sfm.SfmImage(file, photos[i].name, photos[i].name, lens.undistorted().K))
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
