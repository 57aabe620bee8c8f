"""Folders of photographs, and scenes in LLFF's layout."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.photos.scene_confs import scene_conf
from xrgs.config import SceneConf
from xrgs.errors import UnreadableError, XrgsError
from xrgs.photos import images, scenes
from xrgs.photos.scenes import folder as scenes_folder

Fill = Callable[..., SceneConf]


def scene_of(path: object) -> SceneConf:
    return scene_conf("folder", path)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "no image in it"),
        (["only.png"], r"only only\.png in it; two or more"),
        (["a.png", "a.jpg"], r"a\.jpg and .*x/a\.png: two images of one name, a; rename one"),
        # One file where a file system ignores case, or composes accents.
        (["A.png", "a.png"], "two images of one name"),
        (
            ["e\N{COMBINING ACUTE ACCENT}.png", "\N{LATIN SMALL LETTER E WITH ACUTE}.png"],
            "one name",
        ),
        (["a.png", "\udcff.png"], r"only a\.png in it; .*; rename: '\\udcff\.png'"),
    ],
)
def test_a_folder_without_a_scene_is_refused(
    fill: Fill, tmp_path: Path, names: list[str], message: str
) -> None:
    with pytest.raises(XrgsError, match=message) as caught:
        scenes.fingerprint(fill(tmp_path / "x", *names))
    assert str(tmp_path / "x") in str(caught.value)


def test_a_missing_folder_or_path_names_the_key(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match=r"scene\.path=.*nowhere: no such folder"):
        scenes.resolve(
            scene_of(tmp_path / "nowhere"),
            tmp_path,
        )
    for file, what in {"a.zip": "an archive", "a.mp4": "a video", "a.xml": "Metashape"}.items():
        (tmp_path / file).touch()
        with pytest.raises(XrgsError, match=rf"{what}.*, not a folder; "):
            scenes.fingerprint(scene_of(tmp_path / file))
    with pytest.raises(XrgsError, match=r"scene\.path is empty"):
        scenes.resolve(scene_conf("folder", name="x"), tmp_path)


def test_what_is_no_regular_file_is_left_out_with_a_warning(fill: Fill, tmp_path: Path) -> None:
    folder = tmp_path / "x"
    conf = fill(folder, "a.png", "b.png")
    only = scenes.fingerprint(conf)
    os.mkfifo(folder / "c.png")
    os.mknod(folder / "d.png", 0o600 | stat.S_IFSOCK)
    (folder / "e.png").symlink_to(folder / "nowhere")
    (folder / "f.png").symlink_to(folder / "c.png")
    (folder / "g.png").mkdir()
    scene = scenes.resolve(conf, tmp_path)
    assert [file.name for file in scene.files.values()] == ["a.png", "b.png"]
    assert scene.fingerprint == only
    assert scene.notes == (
        "left out, neither regular files nor links to one (pipes?): c.png, d.png, e.png, f.png",
    )


def test_a_photograph_that_cant_be_read_now_stops_the_plan(
    fill: Fill, tmp_path: Path, unreadable: Callable[[str], None]
) -> None:
    """Without it the scene would be another one, for which every cell is trained anew."""
    conf = fill(tmp_path / "x", "a.png", "b.png")
    unreadable("b.png")
    with pytest.raises(UnreadableError, match=r"x/b\.png: Input/output error; try again"):
        scenes.fingerprint(conf)


def test_all_folders_below_are_taken_where_the_path_asks_for_them(
    fill: Fill, tmp_path: Path
) -> None:
    fill(tmp_path / "x", "a.png", "b.png")
    fill(tmp_path / "x" / "day" / "one", "a.png")
    fill(tmp_path / "x" / ".cache", "z.png")
    (tmp_path / "x" / "loop").symlink_to(tmp_path / "x")
    flat = scene_of(tmp_path / "x")
    scene = scenes.resolve(flat, tmp_path)
    assert list(scene.files) == ["a", "b"]
    assert scene.notes == (
        "images left out: 1 in day/one"
        f" (scene.path={tmp_path / 'x'}/** takes the images of all folders)",
    )
    nested = scene_of(f"{tmp_path / 'x'}/**")
    scene = scenes.resolve(nested, tmp_path)
    assert {n: f.relative_to(tmp_path / "x").as_posix() for n, f in scene.files.items()} == {
        "a": "a.png",
        "b": "b.png",
        "day_one_a": "day/one/a.png",
    }
    assert (scene.name, scene.notes) == ("x", ())
    assert scenes.fingerprint(nested) != scenes.fingerprint(flat)


def test_photographs_whose_names_can_not_be_used_are_left_out_by_name(
    fill: Fill, tmp_path: Path
) -> None:
    """Before copies are, so that a copy of another name stays."""
    conf = fill(tmp_path / "x", "b.png", "c.png")
    only = scenes.fingerprint(conf)
    for name in ("IMG\n5.png", "a\\5.png", "\udcff.png"):
        (tmp_path / "x" / name).write_bytes((tmp_path / "x" / "b.png").read_bytes())
    scene = scenes.resolve(conf, tmp_path)
    assert (list(scene.files), scene.fingerprint) == (["b", "c"], only)
    (note,) = scene.notes
    assert note.startswith("3 images left out, whose name has a backslash, a control character or")
    assert note.endswith(r"rename: 'IMG\n5.png', 'a\\5.png', '\udcff.png'")


def test_a_folder_that_is_left_out_may_have_a_name_that_is_no_text(
    fill: Fill, tmp_path: Path
) -> None:
    fill(tmp_path / "x", "a.png", "b.png")
    fill(tmp_path / "x" / "masks\udcff", "a.png")
    (note,) = scenes.resolve(scene_of(f"{tmp_path / 'x'}/**"), tmp_path).notes
    assert note.startswith("images left out: 1 in masks  (masks; scene.masks=")
    note.encode()


def test_what_is_nested_too_deep_is_left_out_by_name(fill: Fill, tmp_path: Path) -> None:
    eight = "a/b/c/d/e/f/g/h"
    fill(tmp_path / "x" / eight, "p.png", "q.png")
    fill(tmp_path / "x" / eight / "i", "r.png")
    fill(tmp_path / "x" / eight / "i" / "j", "s.png")
    left_out = f"images left out: 2 in {eight}/i (nested more than 8 folders deep; move them up)"
    scene = scenes.resolve(scene_of(f"{tmp_path / 'x'}/**"), tmp_path)
    assert list(scene.files) == ["a_b_c_d_e_f_g_h_p", "a_b_c_d_e_f_g_h_q"]
    assert scene.notes == (left_out,)
    flat = scenes.resolve(fill(tmp_path / "x", "t.png", "u.png"), tmp_path)
    assert flat.notes[1:] == (left_out,)


def test_what_is_not_read_is_named(fill: Fill, tmp_path: Path) -> None:
    conf = fill(tmp_path / "x", "a.png", "b.png")
    for name in ("c.DNG", "d.mov", "more.zip", "notes.txt"):
        (tmp_path / "x" / name).write_bytes(b"content")
    videos, formats, archives = scenes.resolve(conf, tmp_path).notes
    assert archives == "archives, which are not looked into; unpack them: more.zip"
    assert "images left out: 1 of a format that is not read (c.DNG)" in formats
    assert f"videos left out: 1 (scene=video scene.path={tmp_path / 'x' / 'd.mov'}" in videos
    fill(tmp_path / "y" / "one", "a.png", "b.png")
    (tmp_path / "y" / "films").mkdir()
    (tmp_path / "y" / "films" / "e.mp4").write_bytes(b"content")
    (videos,) = scenes.resolve(scene_of(f"{tmp_path / 'y'}/**"), tmp_path).notes
    assert "films/e.mp4" in videos


def test_heic_is_listed_and_needs_its_package(
    fill: Fill, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conf = fill(tmp_path / "x", "a.png")
    (tmp_path / "x" / "b.HEIC").write_bytes(b"content")
    assert scenes.names(conf) == ["a", "b"]
    monkeypatch.setattr(scenes_folder, "find_spec", lambda _: None)
    with pytest.raises(XrgsError, match=r"b\.HEIC: 1 of 2 .*pip install 'xrgs\[heic\]'"):
        scenes.names(conf)


SAVED = {
    **dict.fromkeys((".jfif", ".JPG", ".jpg_large", ""), "JPEG"),
    ".pgm": "PPM",
    ".dib": "BMP",
    ".TGA": "TGA",
    ".mpo": "MPO",
    ".jp2": "JPEG2000",
    ".avif": "AVIF",
    ".webp": "WEBP",
    ".apng": "PNG",
    ".TIFF": "TIFF",
}


@pytest.mark.parametrize("suffix", SAVED)
def test_photographs_of_any_suffix_that_pillow_opens_are_taken(
    fill: Fill, tmp_path: Path, suffix: str
) -> None:
    fill(tmp_path, "a.jpg", "b.jpg")
    mode = "L" if suffix == ".pgm" else "RGB"
    photograph = Image.linear_gradient("L").convert(mode).resize((40, 30))
    photograph.save(tmp_path / f"IMG_1{suffix}", SAVED[suffix])
    found = scenes_folder.look(str(tmp_path), 0)
    assert [*found.files] == ["IMG_1", "a", "b"]
    rare = suffix.lower() not in images.USUAL_SUFFIXES
    said = f"taken as photographs by what is in the files: IMG_1{suffix}"
    assert found.notes == ((said,) if rare else ())
    scene = scenes.resolve(scene_of(tmp_path), tmp_path / "cache")
    shown = images.read(scene.files["IMG_1"])
    truth = np.asarray(photograph.convert("RGB")) / 255
    assert np.abs(shown - truth).max() < 0.06  # JPEG and AVIF lose a little


def test_a_grey_map_of_16_bits_is_not_cut(tmp_path: Path) -> None:
    values = np.linspace(0, 65535, 12).round().astype(">u2")
    (tmp_path / "a.pgm").write_bytes(b"P5 4 3 65535\n" + values.tobytes())
    truth = values.reshape(3, 4, 1).astype(np.float64) / 65535
    assert np.abs(images.read(tmp_path / "a.pgm") - truth).max() < 1e-6
    assert images.header(tmp_path / "a.pgm").bits == 16


@pytest.mark.parametrize(
    "form",
    [
        *("{}.jpg.mask.png", "{}_mask_0.png", "mask_{}.png", "{}_depth.png"),
        *("{}_MASK.PNG", "{}.png", "person_{}.png", "{}.alpha.tif"),
    ],
)
def test_masks_of_other_programs_beside_photographs_are_no_photographs(
    fill: Fill, tmp_path: Path, form: str
) -> None:
    fill(tmp_path, "IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg", "IMG_1_2.jpg", "a_IMG_1.jpg")
    mask = Image.fromarray(np.uint8(255 * (np.indices((30, 40)).sum(0) > 30)))
    for name in ("IMG_1", "IMG_2"):
        mask.save(tmp_path / form.format(name))
    found = scenes_folder.look(str(tmp_path), 0)
    assert [*found.files] == ["IMG_1", "IMG_1_2", "IMG_2", "IMG_3", "a_IMG_1"]
    assert all(file.suffix == ".jpg" and "mask" not in file.name for file in found.files.values())
    (note,) = found.notes
    assert note.startswith("2 images left out, which are masks, depth maps or thumbnails")
    assert form.format("IMG_1") in note
