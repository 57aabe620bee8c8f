from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.photos.scene_confs import whole_sizes
from xrgs.errors import UnreadableError, XrgsError
from xrgs.mixture.photographs import (
    assign_cameras,
    largest_of_shape,
    prepare_hr_views,
    write_degraded,
)
from xrgs.photos import images
from xrgs.photos.scenes import Scene


def write_photograph(
    file: Path,
    size: tuple[int, int] = (60, 40),
    model: str = "",
    focal: float = 0,
    orientation: int = 1,
) -> Path:
    """Write a photograph as a camera does: `size` is that before the EXIF orientation."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    if model:
        exif[0x010F], exif[0x0110] = "Maker", model
    if focal:
        exif.get_ifd(0x8769)[0x920A] = focal
    ramp = np.linspace(0, 255, size[0]).astype(np.uint8)
    pixels = np.broadcast_to(ramp[None, :, None], (size[1], size[0], 3))
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, exif=exif, quality=95)
    return file


def camera_numbers(files: list[Path], how: str = "auto") -> list[int]:
    """The camera of each photograph, numbered by first use."""
    names = assign_cameras(files, [images.size(file) for file in files], how)
    return [list(dict.fromkeys(names)).index(name) for name in names]


def test_photographs_of_a_common_size_without_exif_share_a_camera(tmp_path: Path) -> None:
    """One odd photograph among nine does not take the camera from the others."""
    sizes = [(60, 40)] * 9 + [(50, 40)]
    files = [write_photograph(tmp_path / f"{i}.png", size) for i, size in enumerate(sizes)]
    assert camera_numbers(files) == [0] * 9 + [1]
    assert camera_numbers(files[1:]) == list(range(9)), "nine of two sizes are too few"
    same = files[:3]
    assert camera_numbers(same) == [0, 0, 0]
    assert camera_numbers(same, "per_image") == [0, 1, 2]
    assert camera_numbers(same, "single") == [0, 0, 0]
    with pytest.raises(XrgsError, match=r"camera=single.*0\.png is 60x40, .*9\.png is 50x40"):
        camera_numbers(files, "single")


@pytest.mark.parametrize("size", [(31, 20), (13, 9), (600, 401)])
def test_a_resized_copy_has_the_shape_and_the_camera_of_the_largest(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    """Sides are rounded to whole px, or cut to them."""
    assert largest_of_shape([(60, 40), size]) == [max((60, 40), size)] * 2
    files = [
        write_photograph(tmp_path / "0.jpg", model="A", focal=35.0),
        write_photograph(tmp_path / "1.jpg", size, model="A", focal=35.0),
    ]
    assert camera_numbers(files) == camera_numbers(files, "single") == [0, 0]
    for other in ((40, 60), (30, 22), (300, 190)):
        assert largest_of_shape([(60, 40), other]) == [(60, 40), other]


@pytest.mark.parametrize(
    ("size", "expected"), [((150, 100), (30, 20)), ((154, 103), (30, 20)), ((77, 152), (15, 30))]
)
def test_a_degraded_copy_for_sfm_keeps_the_aspect_ratio(
    tmp_path: Path, size: tuple[int, int], expected: tuple[int, int]
) -> None:
    """154 x 103 px at a fifth are 31 x 21, whose pixels are no squares of the photograph."""
    files = {name: write_photograph(tmp_path / f"{name}.png", size) for name in "ab"}
    conf = replace(whole_sizes(), factor=5)
    photos = prepare_hr_views(Scene("x", "", files), conf, tmp_path, for_sfm=True)
    write_degraded(photos, [0], conf, "sfm_lr")
    assert photos.size("sfm_lr", 0) == expected
    assert photos.size(photos.upsampled("sfm_lr", 0), 0) == photos[0].sfm == size
    assert photos.upsampled("sfm", 0) == "sfm"


def test_exif_tells_cameras_lenses_and_how_they_were_held(tmp_path: Path) -> None:
    files = [
        write_photograph(tmp_path / "0.jpg", model="A", focal=35.0),
        write_photograph(tmp_path / "1.jpg", model="A", focal=35.0),
        write_photograph(tmp_path / "2.jpg", model="A", focal=50.0),
        write_photograph(tmp_path / "3.jpg", model="B", focal=35.0),
        write_photograph(tmp_path / "4.jpg", model="A", focal=35.0, orientation=6),
        write_photograph(tmp_path / "5.jpg", (30, 20), model="A", focal=35.0),
        write_photograph(tmp_path / "6.jpg", model="A", focal=35.0),
        write_photograph(tmp_path / "7.jpg"),
        write_photograph(tmp_path / "8.jpg"),
    ]
    assert camera_numbers(files) == [0, 0, 1, 2, 3, 0, 0, 4, 5]


def test_all_are_shrunk_by_one_scale(tmp_path: Path) -> None:
    sizes = [(200, 100), (100, 200), (120, 60), (50, 50)]
    files = [write_photograph(tmp_path / f"{i}.png", size) for i, size in enumerate(sizes)]
    conf = replace(whole_sizes(), long_side=100)
    photos = prepare_hr_views(Scene("x", "", {file.stem: file for file in files}), conf, tmp_path)
    assert [p.hr.resized for p in photos.all] == [(100, 50), (50, 100), (60, 30), (25, 25)]
    assert [(p.hr.width, p.hr.height) for p in photos.all][-1] == (24, 24)
    assert photos.size("hr", 3) == (24, 24)


def scene_of(*files: Path) -> Scene:
    return Scene("x", "", {file.stem: file for file in files})


@pytest.mark.parametrize(
    ("long_side", "factor", "helps"),
    [
        (0, 4, "lower variant.factor to 3"),
        (40, 3, "lower variant.factor to 2 or raise variant.long_side=40"),
        (10, 60, "the photograph is too small"),
        (0, 60, "lower variant.factor to 3"),
    ],
)
def test_where_all_are_too_small_the_error_names_the_keys_that_help(
    tmp_path: Path, long_side: int, factor: int, helps: str
) -> None:
    files = [write_photograph(tmp_path / f"{name}.png", (60, 34)) for name in "ab"]
    conf = replace(whole_sizes(), long_side=long_side, factor=factor)
    with pytest.raises(
        XrgsError, match=r"scene x: 0 photograph.*a\.png, b\.png \(variant"
    ) as error:
        prepare_hr_views(scene_of(*files), conf, tmp_path)
    assert str(error.value).endswith(f"11 px); {helps}")


@pytest.mark.parametrize("damage", ["no header", "truncated"])
def test_a_damaged_photograph_is_left_out_and_sets_no_size(tmp_path: Path, damage: str) -> None:
    write_photograph(tmp_path / "b.png", (600, 400))
    content = (tmp_path / "b.png").read_bytes()
    (tmp_path / "b.png").write_bytes(b"no image" if damage == "no header" else content[:-400])
    files = [
        write_photograph(tmp_path / "a.png"),
        tmp_path / "b.png",
        write_photograph(tmp_path / "c.png"),
    ]
    conf = replace(whole_sizes(), long_side=60)
    photos = prepare_hr_views(scene_of(*files), conf, tmp_path)
    assert photos.names == ["a", "c"]
    assert [photo.hr.resized for photo in photos.all] == [(60, 40)] * 2
    assert photos.size("hr", 1) == (60, 40)
    (note,) = photos.notes
    assert note.startswith("left out: b.png (unreadable or truncated")
    with pytest.raises(XrgsError, match=r"scene x: 1 photograph.*needed: b\.png \(unreadable"):
        prepare_hr_views(scene_of(*files[:2]), whole_sizes(), tmp_path)


@pytest.mark.parametrize("failing", ["header", "decode"])
def test_a_photograph_that_cant_be_read_now_is_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """A variant without it would be frozen as that of all photographs."""
    files = [write_photograph(tmp_path / f"{name}.png") for name in "abc"]
    reader = getattr(images, failing)

    def fails(file: Path) -> object:
        if file.name == "b.png":
            raise UnreadableError("b.png: Input/output error")
        return reader(file)

    monkeypatch.setattr(images, failing, fails)
    with pytest.raises(UnreadableError, match=r"b\.png"):
        prepare_hr_views(scene_of(*files), whole_sizes(), tmp_path)


@pytest.mark.parametrize(("suffix", "kind"), [("png", np.uint16), ("tif", np.float32)])
def test_a_depth_map_is_left_out_beside_photographs(
    tmp_path: Path, suffix: str, kind: type[np.generic]
) -> None:
    files = [write_photograph(tmp_path / f"{name}.png") for name in "ab"]
    depth = tmp_path / f"depth.{suffix}"
    Image.fromarray(np.zeros((400, 600), kind)).save(depth)
    photos = prepare_hr_views(
        scene_of(*files, depth), replace(whole_sizes(), long_side=60), tmp_path
    )
    assert [photo.hr.resized for photo in photos.all] == [(60, 40)] * 2
    (note,) = photos.notes
    assert note.startswith(f"left out: depth.{suffix} (taken for a depth map: it has one channel")


@pytest.mark.parametrize("alpha", ["composite", "mask"])
def test_transparent_pixels_get_the_background_alone(tmp_path: Path, alpha: str) -> None:
    files = [tmp_path / f"{hidden}.png" for hidden in (20, 230)]
    for file in files:  # white, with a quarter of alpha 0 on the left and one of 0.6 on the right
        pixels = np.full((40, 60, 4), 255, np.uint8)
        pixels[:, :15] = (*[int(file.stem)] * 3, 0)
        pixels[:, 45:, 3] = 153
        Image.fromarray(pixels).save(file)
    scene = replace(scene_of(*files), alpha=alpha, background=(0.2, 0.2, 0.2))
    photos = prepare_hr_views(scene, whole_sizes(), tmp_path)
    for i in (0, 1):
        view = photos.read("hr" if alpha == "composite" else "shown", i)
        assert np.abs(view[:, :15] - 0.2).max() < 0.003
        assert (view[:, 15:45] == 1).all()
        assert np.abs(view[:, 45:] - (0.6 + 0.4 * 0.2)).max() < 0.003
        assert alpha == "composite" or (photos.read("hr", i) == 1).all()
    (note,) = photos.notes
    assert note.endswith(": 20.png, 230.png")
    assert ("[0.2, 0.2, 0.2]" if alpha == "composite" else "scene.alpha=mask") in note
