"""One photograph is taken once, however often a folder has it; two photographs are both taken."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageEnhance

from xrgs.photos import images
from xrgs.photos.scenes import folder
from xrgs.photos.scenes.folder import Listing
from xrgs.safeio.atomic import atomic_writer


def picture(number: int, size: tuple[int, int] = (160, 120)) -> Image.Image:
    """Return the photograph of a number in a size: smooth colours, which resizing keeps."""
    colours = np.random.default_rng(number).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    large = Image.fromarray(colours).resize((320, 240), Image.Resampling.BICUBIC)
    return large.resize(size, Image.Resampling.LANCZOS)


def write(file: Path, number: int, size: tuple[int, int] = (160, 120)) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    picture(number, size).save(file)
    return file


def shoot(path: Path, count: int = 6, size: tuple[int, int] = (160, 120), first: int = 0) -> Path:
    """Fill a folder with photographs `IMG_0.jpg` and so on."""
    for number in range(count):
        write(path / f"IMG_{number}.jpg", first + number, size)
    return path


def names(path: Path, found: Listing) -> list[str]:
    return sorted(file.relative_to(path).as_posix() for file in found.files.values())


def below(path: Path, long_side: int = 0) -> Listing:
    return folder.look(f"{path}/**", long_side)


ORIGINALS = [f"IMG_{number}.jpg" for number in range(6)]


def test_files_of_the_same_bytes_are_taken_once(tmp_path: Path) -> None:
    shoot(tmp_path)
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).touch()  # empty files are no copies of each other
    shutil.copy(tmp_path / "IMG_0.jpg", tmp_path / "IMG_0 (1).jpg")
    shutil.copy(tmp_path / "IMG_1.jpg", tmp_path / "Copy of IMG_1.jpg")
    shutil.copy(tmp_path / "IMG_2.jpg", tmp_path / "DSC_0817.jpg")
    found = folder.look(str(tmp_path), 0)
    assert names(tmp_path, found) == [*ORIGINALS, "a.jpg", "b.jpg"]
    assert found.notes == (
        "3 left out as identical copies (the same bytes): Copy of IMG_1.jpg (of IMG_1.jpg),"
        " DSC_0817.jpg (of IMG_2.jpg), IMG_0 (1).jpg (of IMG_0.jpg)",
    )


@pytest.mark.parametrize("name", ["small-IMG_3.png", "IMG_3.png", "IMG_3half.jpg"])
def test_a_resized_copy_in_the_folder_is_left_out(tmp_path: Path, name: str) -> None:
    shoot(tmp_path)
    write(tmp_path / name, 3, (80, 60))
    found = folder.look(str(tmp_path), 0)
    assert names(tmp_path, found) == ORIGINALS
    (note,) = found.notes
    assert f"(the same picture): {name} (of IMG_3.jpg)" in note


def test_other_photographs_with_related_names_stay(tmp_path: Path) -> None:
    shoot(tmp_path)
    write(tmp_path / "IMG_3_b.jpg", 77)
    write(tmp_path / "IMG_3-c.jpg", 78, (80, 60))
    found = folder.look(str(tmp_path), 0)
    assert len(found.files) == 8
    assert not found.notes


def test_photographs_of_one_name_in_two_folders_stay(tmp_path: Path) -> None:
    shoot(tmp_path / "day0")
    shoot(tmp_path / "day1", first=50)
    shoot(tmp_path / "night", first=100, size=(80, 60))
    found = below(tmp_path)
    assert len(found.files) == 18
    assert list(found.files)[::6] == ["day0_IMG_0", "day1_IMG_0", "night_IMG_0"]
    assert not found.notes


@pytest.mark.parametrize("size", [(80, 60), (160, 120)])
def test_a_folder_of_resized_copies_is_left_out(tmp_path: Path, size: tuple[int, int]) -> None:
    shoot(tmp_path)
    for number in range(6):
        write(tmp_path / "resized" / f"img_{number}.PNG", number, size)
    found = below(tmp_path)
    assert names(tmp_path, found) == ORIGINALS
    (note,) = found.notes
    assert note.startswith(
        "6 left out as copies in another size or format (the same picture): resized"
    )


@pytest.mark.parametrize(("long_side", "taken"), [(80, "images_2"), (100, "images")])
def test_of_the_sizes_of_an_llff_scene_one_is_taken(
    tmp_path: Path, long_side: int, taken: str
) -> None:
    shoot(tmp_path / "scene" / "images")
    for number in range(6):  # LLFF's own copies have other names
        write(tmp_path / "scene" / "images_2" / f"image{number:03}.png", number, (80, 60))
        write(tmp_path / "scene" / "images_4" / f"image{number:03}.png", number, (40, 30))
    for found in (below(tmp_path, long_side), folder.look(str(tmp_path / "scene"), long_side)):
        assert {file.parent.name for file in found.files.values()} == {taken}
        assert found.notes == (
            f"images, images_2, images_4 are copies in several sizes: {taken} is taken",
        )


@pytest.mark.parametrize("fault", ["missing", "truncated"])
def test_sizes_that_lack_photographs_are_not_taken(tmp_path: Path, fault: str) -> None:
    shoot(tmp_path / "images")
    shoot(tmp_path / "images_2", size=(80, 60))
    for number in range(4, 6):
        file = tmp_path / "images_2" / f"IMG_{number}.jpg"
        content = file.read_bytes()
        file.write_bytes(content[: len(content) // 2] if fault == "truncated" else b"")
        if fault == "missing":
            file.unlink()
    for found in (below(tmp_path, 80), folder.look(str(tmp_path), 80)):
        assert {file.parent.name for file in found.files.values()} == {"images"}
        assert "images_2 has 4 of the 6 photographs of images" in found.notes[0]


def test_a_store_and_all_that_xrgs_writes_are_left_out(tmp_path: Path) -> None:
    shoot(tmp_path / "day")
    for part in ("cells", "variants", "sweeps"):
        (tmp_path / "my results" / part).mkdir(parents=True)
    shoot(tmp_path / "my results" / "variants" / "k-1" / "images" / "train")
    for made, files in (
        ("copied variant", ["variant.json"]),
        ("copied cell", ["config.json", "identity.json"]),
        ("an export", ["split.json", "transform.json"]),
        ("a report", ["cells.csv", "table.md"]),
    ):
        shoot(tmp_path / "out" / made / "images", 2)
        for name in files:
            (tmp_path / "out" / made / name).touch()
    found = below(tmp_path)
    assert names(tmp_path, found) == [f"day/{name}" for name in ORIGINALS]
    assert "images left out: 6 in my results (a store of xrgs)" in found.notes
    assert "images left out: 2 in out/an export (an export of xrgs)" in found.notes
    assert len(found.notes) == 5
    assert len(folder.look(str(tmp_path / "out" / "an export" / "images"), 0).files) == 2


def test_pngs_of_xrgs_beside_photographs_are_left_out(tmp_path: Path) -> None:
    shoot(tmp_path / "day")
    for name in ("film/0000.png", "film/0001.png", "day/k-1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        with atomic_writer(tmp_path / name) as stream:
            images.write_png(stream, picture(9))
    write(tmp_path / "day" / "screenshot.png", 33)
    found = below(tmp_path)
    assert names(tmp_path, found)[5:] == ["day/IMG_5.jpg", "day/screenshot.png"]
    assert found.notes == (
        "3 images left out, which xrgs made: day/k-1.png, film/0000.png, film/0001.png",
    )


@pytest.mark.parametrize("name", ["Mask", "person_masks", "segmentation"])
def test_folders_of_masks_are_named_with_the_key_that_uses_them(tmp_path: Path, name: str) -> None:
    shoot(tmp_path)
    shoot(tmp_path / name, 4, first=90)
    for found in (below(tmp_path), folder.look(str(tmp_path), 0)):
        assert names(tmp_path, found) == ORIGINALS
        assert found.notes == (
            f"images left out: 4 in {name} (masks; scene.masks={tmp_path / name} uses them)",
        )


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_masks_with_the_names_of_photographs_are_left_out_in_any_folder(
    tmp_path: Path, mode: str
) -> None:
    shoot(tmp_path)
    (tmp_path / "labels").mkdir()
    for number in range(6):
        mask = picture(number + 20).convert("L")
        mask = mask if mode == "L" else mask.point(lambda grey: 255 * (grey > 99)).convert("RGB")
        mask.save(tmp_path / "labels" / f"IMG_{number}.png")
    found = below(tmp_path)
    assert names(tmp_path, found) == ORIGINALS
    assert "6 images left out" in found.notes[0]
    assert folder.look(str(tmp_path), 0).notes == (
        f"images left out: 6 in labels (masks; scene.masks={tmp_path / 'labels'} uses them)",
    )


@pytest.mark.parametrize("sibling", ["input", "stereo"])
def test_of_photographs_and_what_colmap_undistorted_the_photographs_are_taken(
    tmp_path: Path, sibling: str
) -> None:
    for name in ("sparse/0", "stereo" if sibling == "stereo" else "input"):
        (tmp_path / name).mkdir(parents=True)
    shoot(tmp_path / "images", size=(158, 119), first=30)
    shoot(tmp_path / "images_2", size=(79, 60), first=30)
    assert {file.parent.name for file in below(tmp_path, 80).files.values()} == {"images"}
    shoot(tmp_path / "input")
    found = below(tmp_path)
    assert {file.parent.name for file in found.files.values()} == {"input"}
    assert "6 in images, 6 in images_2 (copies that COLMAP undistorted)" in found.notes[0]


def test_a_photograph_that_was_edited_is_taken_once(tmp_path: Path) -> None:
    shoot(tmp_path)
    for name, number in (("IMG_E1.jpg", 1), ("IMG_2-edited.jpg", 2)):
        ImageEnhance.Brightness(picture(number)).enhance(0.9).save(tmp_path / name)
    assert names(tmp_path, folder.look(str(tmp_path), 0)) == ORIGINALS


@pytest.mark.parametrize("readable", [True, False])
def test_of_heic_and_jpeg_of_one_name_one_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, readable: bool
) -> None:
    heif = pytest.importorskip("pillow_heif")
    shoot(tmp_path)
    heif.from_pillow(picture(0)).save(tmp_path / "IMG_0.HEIC", quality=60)
    if not readable:
        monkeypatch.setattr(folder, "find_spec", lambda _: None)
        monkeypatch.setitem(sys.modules, "pillow_heif", None)
    found = folder.look(str(tmp_path), 0)
    assert names(tmp_path, found) == ORIGINALS
    assert "IMG_0.HEIC (of IMG_0.jpg)" in found.notes[0]


@pytest.mark.slow
@pytest.mark.data
def test_neighbouring_views_of_two_cameras_and_of_a_burst_stay(
    data_root: Path, tmp_path: Path
) -> None:
    """trex has neighbouring views with a correlation of 0.997 on thumbnails of 16 px."""
    photographs = sorted((data_root / "llff" / "trex" / "images").iterdir())[:12]
    for number, (left, right) in enumerate(zip(photographs[::2], photographs[1::2], strict=True)):
        for file, name, side in (
            (left, f"rig/camera/IMG_{number}.jpg", 1002),
            (right, f"rig/phone/IMG_{number}.jpg", 334),
            (left, f"burst/{number}.jpg", 501),
            (right, f"burst/{number}_1.jpg", 501),
            (left, f"web/img_{number}.jpg", 334),
        ):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            with Image.open(file) as image:
                image.resize((side, 3 * side // 4)).save(tmp_path / name, quality=60)
    for part in ("rig", "burst"):
        assert len(below(tmp_path / part).files) == 12
    (tmp_path / "web").rename(tmp_path / "rig" / "web")
    assert len(below(tmp_path / "rig").files) == 12


def test_panoramas_are_left_out_and_screenshots_are_named(tmp_path: Path) -> None:
    shoot(tmp_path)
    write(tmp_path / "pano.jpg", 40, (400, 120))
    write(tmp_path / "screenshot.png", 41, (73, 158))
    found = folder.look(str(tmp_path), 0)
    assert names(tmp_path, found) == [*ORIGINALS, "screenshot.png"]
    assert found.notes == (
        "left out as panoramas, by their shape: pano.jpg",
        "longer for their width than others (screenshots, crops?): screenshot.png",
    )
    shoot(tmp_path / "wide", size=(320, 130), first=20)
    assert not folder.look(str(tmp_path / "wide"), 0).notes


def test_links_to_folders_elsewhere_are_named(tmp_path: Path) -> None:
    shoot(tmp_path / "elsewhere", first=30)
    shoot(tmp_path / "here" / "day")
    (tmp_path / "here" / "more").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "here" / "day" / "again").symlink_to(tmp_path / "here")
    assert below(tmp_path / "here").notes == (
        "images left out: 6 in more (links to folders are not followed)",
    )


def test_photographs_with_films_behind_them_are_whole(tmp_path: Path) -> None:
    for file in shoot(tmp_path / "images").iterdir():
        file.write_bytes(file.read_bytes() + bytes(5000))
    shoot(tmp_path / "images_2", size=(80, 60))
    assert folder.look(str(tmp_path), 0).files["IMG_0"].parent.name == "images"


def test_dark_photographs_of_one_name_stay(tmp_path: Path) -> None:
    for day in range(2):
        for number in range(3):
            file = tmp_path / f"night{day}" / f"{number}.png"
            file.parent.mkdir(exist_ok=True)
            dark = ImageEnhance.Brightness(picture(10 * day + number)).enhance(0.02)
            dark.resize((160 - 40 * day, 120 - 30 * day)).save(file)
    assert len(below(tmp_path).files) == 6


def test_grey_photographs_stay(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path / f"{number}.png", number)
        picture(number).convert("L").save(tmp_path / f"{number}.png")
    assert len(folder.look(str(tmp_path), 0).files) == 4
