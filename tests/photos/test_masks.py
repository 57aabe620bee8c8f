"""Masks against PIL's turning and closed forms; what they hide changes no bit of the rest."""

from __future__ import annotations

import io
import unicodedata
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image, ImageOps

from tests.photos.scene_confs import scene_conf, whole_sizes
from xrgs.config import SfmConf
from xrgs.errors import XrgsError
from xrgs.mixture import sfm, sfm_retries
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views, write_degraded
from xrgs.photos import images, masks, scenes
from xrgs.photos.lens import Lens
from xrgs.photos.masks import Masks
from xrgs.photos.scenes import Scene

Mask = NDArray[np.bool_]


def save(file: Path, pixels: Any, **options: Any) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels)).save(file, **options)
    return file


def noise(size: tuple[int, int], seed: int = 0) -> NDArray[np.uint8]:
    """Random colours [H, W, 3] for a size (width, height)."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)


# finding


@pytest.mark.parametrize(
    ("photograph", "inside"),
    [
        ("IMG_1", "IMG_1.JPG.PNG"),
        ("IMG_1", "img_1.tiff"),
        ("IMG_1", "mask_IMG_1.png"),
        ("IMG_1", "IMG_1.jpg.mask.png"),
        ("IMG.1", "IMG.1.jpg.png"),
        ("rig1_back_0004", "rig1/back/0004.jpg.png"),
        ("my mask", "my mask.png"),
        (unicodedata.normalize("NFD", "café"), unicodedata.normalize("NFC", "Café.png")),
    ],
)
def test_the_mask_of_a_photograph_is_found_by_its_name(
    tmp_path: Path, photograph: str, inside: str
) -> None:
    save(tmp_path / inside, np.zeros((4, 6), np.uint8))
    found, notes = masks.find(str(tmp_path), {photograph: Path("x")})
    assert found == {photograph: tmp_path / inside}
    assert notes == ()


def test_photographs_without_masks_and_masks_without_photographs_are_said(tmp_path: Path) -> None:
    for name in ("a.png", "z.png", ".hidden/b.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found, notes = masks.find(str(tmp_path), dict.fromkeys("abc", Path("x")))
    assert list(found) == ["a"]
    assert notes == (
        "no mask in scene.masks, so that all pixels are used: b, c",
        "masks of no photograph in scene.masks: z.png",
    )


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a.png", "a.jpg.png"], r"a\.jpg\.png and a\.png are both masks of a; remove one"),
        (["x.png"], r"no mask of a photograph in it, only x\.png; the mask of a is a\.png"),
        ([], r"no mask of a photograph in it, no image; the mask of a is a\.png"),
    ],
)
def test_a_folder_that_can_not_be_meant_is_refused(
    tmp_path: Path, names: list[str], message: str
) -> None:
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(XrgsError, match=message):
        masks.find(str(tmp_path), {"a": Path("x")})
    with pytest.raises(XrgsError, match=r"scene\.masks=.*/none: no such folder"):
        masks.find(str(tmp_path / "none"), {"a": Path("x")})


def test_the_fingerprint_of_a_scene_has_the_bytes_of_its_masks(tmp_path: Path) -> None:
    """Masks below the photographs are no photographs."""
    for number in range(3):
        save(tmp_path / "photos" / f"{number}.png", noise((60, 40), number))
        save(tmp_path / "photos" / "m" / f"{number}.png", np.full((40, 60, 3), 255, np.uint8))
    conf = replace(scene_conf("folder", f"{tmp_path}/photos/**"), masks=f"{tmp_path}/photos/m")
    found = scenes.resolve(conf, tmp_path)
    assert list(found.files) == list(found.masks) == ["0", "1", "2"]
    assert found.notes == ()
    before = scenes.fingerprint(conf)
    assert before == scenes.fingerprint(replace(conf, masks=f"{tmp_path}/photos/../photos/m"))
    save(tmp_path / "photos" / "m" / "1.png", np.zeros((40, 60, 3), np.uint8))
    assert scenes.fingerprint(conf) != before


# reading

USED = np.zeros((40, 60), np.bool_)
USED[:, 30:] = True


GREY = Image.fromarray(USED * np.uint8(255))
#: White, and opaque only where it is used.
TRANSPARENT = Image.merge("RGBA", [*[Image.new("L", (60, 40), 255)] * 3, GREY])
FORMS: dict[str, tuple[Image.Image, str]] = {
    "1 bit": (GREY.convert("1"), "png"),
    "transparent where it is not used": (TRANSPARENT, "png"),
    "palette": (GREY.convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE), "png"),
    "a colour": (
        Image.merge("RGB", [Image.new("L", (60, 40)), GREY, Image.new("L", (60, 40))]),
        "png",
    ),
    "16 bits": (Image.fromarray(USED * np.uint16(65535)), "png"),
    "labels 0 and 1 as RGB": (Image.fromarray(USED.astype(np.uint8)).convert("RGB"), "png"),
    "JPEG": (GREY, "jpg"),
    "twice the size": (GREY.resize((120, 80)), "png"),
}


def read_a(given_masks: Masks, photograph: images.Header) -> Mask:
    mask, _ = given_masks.read("a", photograph)
    assert mask is not None
    return mask


def read(file: Path, photograph: Path) -> Mask:
    header = images.header(photograph)
    return read_a(Masks.fitted({"a": file}, {"a": header}), header)


@pytest.mark.parametrize("form", FORMS)
def test_white_is_used_in_every_kind_of_image(tmp_path: Path, form: str) -> None:
    picture, suffix = FORMS[form]
    picture.save(tmp_path / f"a.{suffix}")
    photograph = save(tmp_path / "photo.png", noise((60, 40)))
    assert (read(tmp_path / f"a.{suffix}", photograph) == USED).all()


def test_a_mask_that_may_be_a_photograph_is_said(tmp_path: Path) -> None:
    files = {name: save(tmp_path / f"{name}.png", noise((60, 40))) for name in "ab"}
    given_masks = {
        "a": save(tmp_path / "photo.png", noise((60, 40), 5)),
        "b": save(tmp_path / "blurred.png", GREY.resize((59, 39)).resize((60, 40))),
    }
    photos = prepare_hr_views(Scene("x", "", files, masks=given_masks), whole_sizes(), tmp_path)
    said = "masks that are not black and white, of which what is brighter than grey is used"
    assert photos.notes == (f"{said}: a.png",)


@pytest.mark.parametrize("size", [(40, 60), (60, 38)])
def test_a_mask_of_another_shape_is_refused_by_name(tmp_path: Path, size: tuple[int, int]) -> None:
    file = save(tmp_path / "a.png", np.zeros((size[1], size[0]), np.uint8))
    with pytest.raises(XrgsError, match=r"a\.png: a mask of .* than a, which has 60 x 40 px"):
        read(file, save(tmp_path / "photo.png", noise((60, 40))))


def test_a_mask_of_one_colour_is_read_however_small_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "_SMALL_PIXELS", 0)
    file = tmp_path / "a.png"
    Image.new("1", (2000, 1500), 255).save(file)
    assert file.stat().st_size < 3 * 2000 * 1500 / 1032
    assert images.decode(file).pixels.min() == 1


def exif_of(orientation: int) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif.tobytes()


def by_pil(mask: Mask, orientation: int) -> Mask:
    """The mask as PIL turns it."""
    file = io.BytesIO()
    Image.fromarray(mask).save(file, "PNG", exif=exif_of(orientation))
    with Image.open(file) as stored:
        return np.asarray(ImageOps.exif_transpose(stored))


CORNER = np.zeros((40, 60), np.bool_)
CORNER[:10, :30] = True


@pytest.mark.parametrize(
    ("orientation", "stored"), [*((turn, True) for turn in range(1, 9)), (3, False), (6, False)]
)
def test_one_mask_shows_how_all_of_a_folder_were_made(
    tmp_path: Path, orientation: int, stored: bool
) -> None:
    """A photograph that EXIF turns by a quarter has a mask of one shape alone."""
    files, headers = {}, {}
    for name, turn in (("tell", 6), ("a", orientation)):
        photograph = save(tmp_path / f"{name}.jpg", noise((60, 40)), exif=exif_of(turn))
        headers[name] = images.header(photograph)
        files[name] = save(
            tmp_path / f"{name}.png", CORNER if stored else by_pil(CORNER, turn).copy()
        )
    given_masks = Masks.fitted(files, headers)
    assert (read_a(given_masks, headers["a"]) == by_pil(CORNER, orientation)).all()
    assert given_masks.notes == ()


def test_masks_that_may_be_turned_or_not_are_said(tmp_path: Path) -> None:
    photograph = save(tmp_path / "a.jpg", noise((60, 40)), exif=exif_of(3))
    headers = {"a": images.header(photograph)}
    given_masks = Masks.fitted({"a": save(tmp_path / "a.png", CORNER)}, headers)
    assert (read_a(given_masks, headers["a"]) == CORNER).all()
    (note,) = given_masks.notes
    assert note.endswith("are taken as turned: a")


def test_a_mask_with_an_orientation_of_its_own_is_of_the_turned_photograph(tmp_path: Path) -> None:
    photograph = save(tmp_path / "a.jpg", noise((60, 40)), exif=exif_of(3))
    mask = save(tmp_path / "a.png", CORNER, exif=exif_of(3))
    assert (read(mask, photograph) == by_pil(CORNER, 3)).all()


# resizing


def test_a_resized_pixel_is_used_where_all_that_it_is_made_of_is() -> None:
    """A triangle of 5 px to each side of a pixel's centre, which is at 5 k + 2.5."""
    for edge in range(20, 40):
        mask = np.zeros((50, 50), np.bool_)
        mask[:, edge:] = True
        columns = np.flatnonzero(masks.resized(mask, 10, 10).all(axis=0))
        centres = 5 * np.arange(10) + 2.5
        weights = np.clip(1 - np.abs(np.arange(50) + 0.5 - centres[:, None]) / 5, 0, None)
        share = weights[:, edge:].sum(axis=1) / weights.sum(axis=1)
        assert (columns == np.flatnonzero(share >= 0.99)).all()


def test_a_pixel_that_is_not_used_has_the_colour_of_the_nearest_one() -> None:
    image = noise((60, 40)).astype(np.float32)
    filled = masks.filled(image, USED)
    assert (filled[:, 30:] == image[:, 30:]).all()
    assert (filled[:, :30] == image[:, 30:31]).all()
    assert masks.filled(image, None) is image
    assert masks.filled(image, np.zeros_like(USED)) is image


# copies


def prepared(
    folder: Path, hidden: NDArray[np.uint8], mask: Mask, alpha: bool = False, **changes: Any
) -> PhotoCollection:
    """Two photographs of which one has a mask, with `hidden` outside of it."""
    folder.mkdir()
    photograph = np.where(mask[..., None], noise((60, 40)), hidden)
    files = {"b": save(folder / "b.png", noise((60, 40), 1))}
    if alpha:
        photograph = np.dstack([photograph, mask * np.uint8(255)])
    files["a"] = save(folder / "a.png", photograph)
    given_masks = {} if alpha else {"a": save(folder / "mask.png", mask)}
    scene = Scene(
        "x",
        "",
        dict(sorted(files.items())),
        masks=given_masks,
        alpha="mask" if alpha else "composite",
    )
    conf = replace(whole_sizes(), **changes)
    photos = prepare_hr_views(scene, conf, folder, for_sfm=True)
    write_degraded(photos, [0, 1], conf)
    write_degraded(photos, [0, 1], conf, "sfm_lr")
    return photos


LENS = Lens("SIMPLE_RADIAL", (50.0, 30.0, 20.0, 0.1), 60, 40)
HIDDEN = st.integers(0, 2**32 - 1).map(lambda seed: noise((60, 40), seed))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degradation", "alpha"), [("downsample", False), ("digital_zoom", True), ("jpeg", False)]
)
@settings(max_examples=3)
@given(hidden=HIDDEN)
def test_what_is_hidden_changes_no_bit_of_what_is_trained_and_scored(
    tmp_path_factory: pytest.TempPathFactory,
    degradation: str,
    alpha: bool,
    hidden: NDArray[np.uint8],
) -> None:
    mask = USED.copy()
    mask[5:15, 40:50] = False
    one, other = (
        prepared(tmp_path_factory.mktemp("p") / "x", h, mask, alpha, degradation=degradation)
        for h in (hidden, np.zeros_like(hidden))
    )
    for kind in ("hr", "lr"):
        assert (one.read(kind, 0) == other.read(kind, 0)).all()
        lens = LENS.resized(*one.size(kind, 0))
        (image, used), (expected, same) = (of.undistorted(kind, 0, lens) for of in (one, other))
        assert used is not None
        assert same is not None
        assert (used == same).all()
        assert (image[used] == expected[used]).all()
        assert 0.2 < used.mean() < mask.mean()
        assert one.mask(kind, 1) is None
    hidden_now = one.undistorted("hr", 0, LENS)
    assert alpha or (hidden_now[0] != other.undistorted("hr", 0, LENS)[0]).any()


def test_a_mask_that_hides_nothing_changes_no_bit(tmp_path: Path) -> None:
    every = np.ones_like(USED)
    masked = prepared(tmp_path / "x", noise((60, 40)), every)
    assert masked.mask("hr", 0) is None
    assert masked.mask("lr", 0) is None
    assert not (tmp_path / "x" / "shown").exists()
    assert (images.to_8_bit(masked.read("hr", 0)) == noise((60, 40))).all()


def test_a_photograph_whose_mask_is_black_is_left_out_by_name(tmp_path: Path) -> None:
    files = {name: save(tmp_path / f"{name}.png", noise((60, 40))) for name in "abc"}
    mask = save(tmp_path / "black.png", np.zeros((40, 60), np.uint8))
    photos = prepare_hr_views(Scene("x", "", files, masks={"b": mask}), whole_sizes(), tmp_path)
    assert photos.names == ["a", "c"]
    assert photos.notes == ("left out: b.png (its mask leaves no pixel)",)


def test_an_upsampled_copy_has_a_mask_where_colmap_looks_for_it(tmp_path: Path) -> None:
    photos = prepared(tmp_path / "x", noise((60, 40)), USED)
    kind = photos.upsampled("sfm_lr", 0)
    used = photos.mask(kind, 0)
    assert used is not None
    assert used.shape == (40, 60)
    assert (tmp_path / "x" / "masks" / f"{photos.file(kind, 0)}.png").is_file()
    assert not used[:, :30].any()
    assert used[:, 34:].all()


# SfM


@pytest.mark.slow
def test_sfm_finds_no_features_outside_a_mask(tmp_path: Path, sfm_conf: SfmConf) -> None:
    photos = prepared(tmp_path / "x", noise((60, 40)), USED, factor=1)
    smooth = [images.resize(photos.read("sfm", i), 480, 320) for i in (0, 1)]
    for i, image in enumerate(smooth):
        images.save(tmp_path / "x" / photos.file("sfm", i), image)
    photos.save_mask("sfm", 0, np.kron(USED, np.ones((8, 8), np.bool_)))
    given_images = sfm_retries.sfm_images(
        photos, (), sfm_retries.Attempt("native", replace(sfm_conf, lr_images="native"))
    )
    assert [image.masked for image in given_images] == [True, False]
    sfm.reconstruct(given_images, tmp_path / "x", tmp_path, sfm_conf)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        columns = {
            image.name: database.read_keypoints(image.image_id)[:, 0]
            for image in database.read_all_images()
        }
        cameras = database.num_cameras()
    masked, whole = (columns[image.file] for image in given_images)
    assert len(masked) > 100
    assert masked.min() >= 240
    assert np.mean(whole < 240) > 0.4
    assert cameras == 1
