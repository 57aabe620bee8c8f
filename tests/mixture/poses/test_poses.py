"""Poses of the user's: which photograph has which, and how EXIF turns them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.mixture.poses.written import (
    PARAMS,
    POINTS,
    project,
    write_colmap,
    write_transforms,
)
from xrgs.errors import XrgsError
from xrgs.mixture import poses
from xrgs.mixture.photographs import PhotoCollection
from xrgs.mixture.views import Reconstruction
from xrgs.photos.scenes import Scene


def upright(
    orientation: int, size: tuple[int, int], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where a pixel of a stored image is in the upright one, by EXIF's standard."""
    (w, h), (x, y) = size, pixels.T
    turned = {1: (x, y), 3: (w - x, h - y), 6: (h - y, x), 8: (y, w - x)}
    return np.stack(turned[orientation], -1)


@pytest.mark.parametrize("layout", ["binary", "text", "transforms", "folder of transforms"])
def test_points_project_to_where_the_cropped_and_resized_photograph_shows_them(
    photos: PhotoCollection, tmp_path: Path, layout: str
) -> None:
    folder = tmp_path / "poses"
    if "transforms" in layout:
        path = write_transforms(folder)
    else:
        path = write_colmap(folder, text=layout == "text")
    model = poses.read_poses(str(path.parent if "folder" in layout else path), photos)
    own = POINTS @ model.world[:3, :3].T + model.world[:3, 3]
    assert np.allclose(model.points, own, atol=1e-6)
    assert (model.colors == (10, 20, 30)).all()
    assert model.lenses.keys() == model.viewmats.keys() == {0, 1, 2}
    in_folder = ["variant.poses: transforms.json is read"] if "folder" in layout else []
    assert model.report["notes"] == in_folder
    for i in range(3):
        # Half the size, then 102 x 76 is cropped to 100 x 75 about its centre: 1 and 0 px.
        assert np.allclose(pixels(model, i), project(i) / 2 - (1, 0), atol=1e-4)
        assert (model.lenses[i].width, model.lenses[i].height) == (100, 75)


def pixels(model: Reconstruction, index: int) -> NDArray[np.float64]:
    camera = model.points @ model.viewmats[index][:3, :3].T + model.viewmats[index][:3, 3]
    projected = camera @ model.lenses[index].K.T
    return projected[:, :2] / projected[:, 2:]


@pytest.mark.parametrize(
    ("orientation", "size"), [(1, (100, 75)), (3, (100, 75)), (6, (75, 100)), (8, (100, 100))]
)
def test_a_pose_of_stored_pixels_is_turned_as_exif_turns_the_photograph(
    photographs: Callable[..., PhotoCollection],
    tmp_path: Path,
    orientation: int,
    size: tuple[int, int],
) -> None:
    params = (150.0, 140.0, 48.0, 41.0)
    path = write_colmap(tmp_path / "poses", params=params, size=size)
    model = poses.read_poses(str(path), photographs(size=size, orientation=orientation))
    turned = size[::-1] if orientation > 4 else size
    for i in range(3):
        fx, fy, cx, cy = PARAMS
        stored = (project(i) - (cx, cy)) / (fx, fy) * params[:2] + params[2:]
        assert pixels(model, i) == pytest.approx(upright(orientation, size, stored))
        assert (model.lenses[i].width, model.lenses[i].height) == turned
        assert np.linalg.det(model.viewmats[i]) == pytest.approx(1)
    notes = ["EXIF turns 3 photographs, and their poses were turned with them"]
    assert [note[: len(notes[0])] for note in model.report["notes"]] == notes * (orientation > 1)


@pytest.mark.parametrize("orientation", [5, 6])
def test_a_pose_of_upright_pixels_stays_as_it_is(
    photographs: Callable[..., PhotoCollection], tmp_path: Path, orientation: int
) -> None:
    """The camera has the shape of the upright photograph, so that it was made with a copy."""
    params = (150.0, 140.0, 41.0, 48.0)
    path = write_colmap(tmp_path / "poses", params=params, size=(75, 100))
    model = poses.read_poses(str(path), photographs(size=(100, 75), orientation=orientation))
    for i in range(3):
        fx, fy, cx, cy = PARAMS
        seen = (project(i) - (cx, cy)) / (fx, fy) * params[:2] + params[2:]
        assert pixels(model, i) == pytest.approx(seen)
    assert model.report["notes"] == []


@pytest.mark.parametrize("upright_copies", [False, True])
def test_one_photograph_decides_for_those_that_fit_both_ways(
    photographs: Callable[..., PhotoCollection], tmp_path: Path, upright_copies: bool
) -> None:
    """EXIF turns one photograph by a quarter and two by half: the cameras are of one kind."""
    photos = photographs(size=(100, 75), orientation={"a": 6, "b": 3, "c": 3})
    file = write_transforms(tmp_path / "poses", {"w": 100, "h": 75})
    content = json.loads(file.read_text())
    if upright_copies:
        content["frames"][0] |= {"w": 75, "h": 100}
        file.write_text(json.dumps(content))
    model = poses.read_poses(str(file), photos)
    for i, orientation in enumerate((6, 3, 3)):
        seen = project(i) if upright_copies else upright(orientation, (100, 75), project(i))
        assert pixels(model, i) == pytest.approx(seen, abs=1e-4)  # the points are float32


@pytest.mark.parametrize("orientation", [2, 7])
def test_a_photograph_that_exif_mirrors_is_refused_by_name(
    photographs: Callable[..., PhotoCollection], tmp_path: Path, orientation: int
) -> None:
    path = write_colmap(tmp_path / "poses", size=(100, 75))
    photos = photographs(size=(100, 75), orientation=orientation)
    with pytest.raises(XrgsError, match=f"poses: EXIF's orientation {orientation} mirrors a, "):
        poses.read_poses(str(path), photos)


def test_the_share_that_undistortion_keeps_is_said(photos: PhotoCollection, tmp_path: Path) -> None:
    path = write_colmap(tmp_path / "poses", "OPENCV_FISHEYE", (60.0, 60, 102, 76, 0, 0, 0, 0))
    (note,) = poses.read_poses(str(path), photos).report["notes"]
    said = r"undistortion keeps (\d\d)% to \1% of 3 photographs with cameras OPENCV_FISHEYE: a, b"
    assert re.match(said, note)


def test_the_fingerprint_is_of_the_content(tmp_path: Path) -> None:
    a, b = write_colmap(tmp_path / "a"), write_colmap(tmp_path / "b")
    c = write_colmap(tmp_path / "c", params=(150.0, 150.0, 104.0, 75.5))
    assert poses.fingerprint(str(a)) == poses.fingerprint(str(b)) != poses.fingerprint(str(c))
    first = poses.fingerprint(str(write_transforms(tmp_path / "d")))
    assert poses.fingerprint(str(tmp_path / "d")) == first
    (tmp_path / "d" / "points.ply").write_bytes(b"other points")
    assert poses.fingerprint(str(tmp_path / "d" / "transforms.json")) != first


@pytest.mark.parametrize(
    ("pose_names", "files", "expected"),
    [
        (("x/a.jpg", "gone.png", "d/c.JPG"), ("a", "b", "c", "d/c"), {0: 0, 2: 3}),
        (("images/rig1/back/4.jpg", "images/rig1/front/4.jpg"), ("rig1/back/4", "rig1/front/4"), 1),
        (("rig1_back_4.jpg", "rig1_front_4.jpg"), ("rig1/back/4", "rig1/front/4"), 1),
        (("x/c/4.jpg", "x/b/4.jpg"), ("a/4", "b/4"), {1: 1}),
        (("C:\\shots\\a.JPG", "C:\\shots\\b.JPG"), ("a", "b"), 1),
        (("/home/me/a.png", "../b.png"), ("a", "b"), 1),
        (("./train/r_0", "./test/r_0"), ("train/r_0", "test/r_0"), 1),
        (("frame.0001", "frame.0002"), ("frame.0001", "frame.0002"), 1),
        (("a 1.jpg", "b.c.d.jpg"), ("a 1", "b.c.d"), 1),
        # Names with dots, whose suffix is omitted; a pose without that suffix has precedence.
        (("./x/5.1.2024_a", "./x/5.1.2024_b"), ("x/5.1.2024_a", "x/5.1.2024_b"), 1),
        (("1.left", "1.right"), ("1.left", "1.right"), 1),
        (("a.png", "b.png"), ("a.png", "a", "b"), {0: 1, 1: 2}),
        # Accents apart, as macOS writes them into names of files, and composed.
        (("x/u\u0308.jpg", "\u00e9.jpg"), ("x/\u00fc", "e\u0301"), 1),
    ],
)
def test_a_pose_has_the_photograph_at_the_end_of_its_path(
    pose_names: Sequence[str], files: Sequence[str], expected: dict[int, int] | int
) -> None:
    named = [(file.replace("/", "_"), Path("/photos") / f"{file}.png") for file in files]
    wanted = expected if isinstance(expected, dict) else {i: i for i in range(len(files))}
    found = poses.match_names(pose_names, named)
    assert found == {pose_names[pose]: photo for pose, photo in wanted.items()}


def test_names_that_fit_nothing_or_alike_are_refused() -> None:
    """But of two poses the one in the same folder is taken."""
    photographs = [("r_0", Path("/lego/train/r_0.png"))]
    assert poses.match_names(["./test/r_0", "./train/r_0"], photographs) == {"./train/r_0": 0}
    with pytest.raises(XrgsError, match=r"none of its 1 images .*: IMG_01\.jpg is not img_1"):
        poses.match_names(["IMG_01.jpg"], [("other", Path("other.png")), ("img_1", Path("img_1"))])
    with pytest.raises(XrgsError, match="it has no image: the program that wrote it placed no"):
        poses.match_names([], photographs)
    with pytest.raises(XrgsError, match=r"two of its images, x/a\.jpg and y/a\.jpg, have the name"):
        poses.match_names(["x/a.jpg", "y/a.jpg"], [("a", Path("a.png"))])


def test_masks_of_a_file_are_those_of_the_photographs(tmp_path: Path) -> None:
    path = str(write_transforms(tmp_path / "poses", {}, {"mask_path": "m.png"}))
    scene = Scene("x", "", {name: tmp_path / f"{name}.png" for name in ("a", "b", "z")})
    made = poses.with_masks(scene, path)
    assert made.masks == dict.fromkeys(("a", "b"), tmp_path / "poses" / "m.png")
    assert made.notes == ("the masks of 2 photographs are those of mask_path in variant.poses",)
    masked = replace(scene, masks={"a": tmp_path / "own.png"})
    made = poses.with_masks(masked, path)
    assert made.masks == masked.masks
    assert made.notes == ("mask_path of variant.poses is not read, since scene.masks has masks",)
    for none in (None, str(write_transforms(tmp_path / "b")), str(write_colmap(tmp_path / "c"))):
        assert poses.with_masks(scene, none) is scene
