from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from xrgs.capture import images, scenes
from xrgs.capture.scenes import motorcycle, procedural
from xrgs.capture.scenes.bundled import photograph
from xrgs.config import SceneConf
from xrgs.errors import XrgsError

PROCEDURAL = SceneConf("procedural", "procedural", None, 3)


def fill(folder: Path, *names: str, size: tuple[int, int] = (40, 30)) -> SceneConf:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(len(names))
    for name in names:
        pixels = rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name)
    return SceneConf("", "folder", str(folder))


def stems(scene: scenes.Scene) -> list[str]:
    return [file.stem for file in scene.files]


# folders


def test_a_folder_is_its_images_sorted_by_name(tmp_path: Path) -> None:
    conf = fill(tmp_path / "my scene é", "b 1.png", "ä.JPG", "a,2.jpeg")
    (tmp_path / "my scene é" / "notes.txt").write_text("no image")
    (tmp_path / "my scene é" / ".hidden.png").write_bytes(b"")
    scene = scenes.resolve(conf, tmp_path / "cache")
    assert stems(scene) == ["a,2", "b 1", "ä"]
    assert scene.name == scenes.label(conf) == "my scene é"
    assert not scene.intrinsics
    assert not scene.viewmats
    assert not (tmp_path / "cache").exists()


def test_a_given_name_wins_over_the_folders(tmp_path: Path) -> None:
    conf = replace(fill(tmp_path / "x", "a.png", "b.png"), name="garden")
    assert scenes.resolve(conf, tmp_path).name == "garden"


def test_the_fingerprint_follows_names_and_bytes_alone(tmp_path: Path) -> None:
    conf = fill(tmp_path / "x", "a.png", "b.png")
    first = scenes.fingerprint(conf)
    moved = fill(tmp_path / "y", "a.png", "b.png")
    assert scenes.fingerprint(moved) == first
    assert scenes.fingerprint(replace(conf, name="other")) == first
    (tmp_path / "y" / "b.png").rename(tmp_path / "y" / "c.png")
    assert scenes.fingerprint(moved) != first
    bytes_ = bytearray((tmp_path / "x" / "a.png").read_bytes())
    bytes_[-1] ^= 1
    (tmp_path / "x" / "a.png").write_bytes(bytes_)
    assert scenes.fingerprint(conf) != first


@pytest.mark.parametrize(
    ("long_side", "width"), [(0, 400), (20, 50), (50, 50), (51, 100), (999, 400)]
)
def test_an_llff_scene_gives_the_smallest_copies_that_suffice(
    tmp_path: Path, long_side: int, width: int
) -> None:
    for folder, size in {"images": 400, "images_4": 100, "images_8": 50}.items():
        fill(tmp_path / folder, "a.png", "b.png", size=(size, size * 3 // 4))
    (tmp_path / "poses_bounds.npy").write_bytes(b"never read")
    scene = scenes.resolve(SceneConf("fern", "folder", str(tmp_path)), tmp_path, long_side)
    assert images.size(scene.files[0])[0] == width


def test_copies_are_measured_by_their_largest_photograph(tmp_path: Path) -> None:
    """Where sizes differ the first alone tells little; what can't be read tells nothing."""
    fill(tmp_path / "images", "a.png", "b.png", size=(400, 300))
    fill(tmp_path / "images_4", "a.png", size=(60, 45))
    fill(tmp_path / "images_4", "b.png", size=(100, 75))
    (tmp_path / "images_4" / "c.png").write_text("no image")
    scene = scenes.resolve(SceneConf("x", "folder", str(tmp_path)), tmp_path, 100)
    assert scene.files[0].parent.name == "images_4"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "no image in it"),
        (["only.png"], r"only only\.png in it; two or more"),
        (["a.png", "a.jpg"], r"a\.jpg and a\.png: two images of one name"),
    ],
)
def test_a_folder_that_is_no_scene_is_named(tmp_path: Path, names: list[str], message: str) -> None:
    with pytest.raises(XrgsError, match=message) as caught:
        scenes.fingerprint(fill(tmp_path / "x", *names))
    assert str(tmp_path / "x") in str(caught.value)


def test_a_missing_folder_or_path_names_the_key(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match=r"scene\.path=.*nowhere: no such folder"):
        scenes.resolve(SceneConf("x", "folder", str(tmp_path / "nowhere")), tmp_path)
    with pytest.raises(XrgsError, match=r"scene\.path is empty"):
        scenes.resolve(SceneConf("x", "folder", None), tmp_path)


def test_an_unknown_kind_names_the_key(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match=r"scene\.kind=llff: unknown; one of procedural"):
        scenes.resolve(SceneConf("x", "llff", str(tmp_path)), tmp_path)


# embedded scenes


def test_the_procedural_scene_is_rendered_once(tmp_path: Path) -> None:
    first = scenes.resolve(PROCEDURAL, tmp_path, 60)
    assert stems(first) == ["view_000", "view_001", "view_002"]
    assert images.size(first.files[0]) == (60, 45)
    assert first.viewmats.keys() == set(stems(first))
    assert not first.intrinsics  # SfM is to find them, as in a real capture
    times = [file.stat().st_mtime_ns for file in first.files]
    again = scenes.resolve(PROCEDURAL, tmp_path, 60)
    assert [file.stat().st_mtime_ns for file in again.files] == times
    assert [p.name for p in tmp_path.iterdir()] == [first.fingerprint]


def test_the_same_scene_is_rendered_to_the_same_bytes(tmp_path: Path) -> None:
    a = scenes.resolve(PROCEDURAL, tmp_path / "a", 60)
    b = scenes.resolve(PROCEDURAL, tmp_path / "b", 60)
    assert [f.read_bytes() for f in a.files] == [f.read_bytes() for f in b.files]


def test_two_who_render_at_once_get_one_whole_scene(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda _: scenes.resolve(PROCEDURAL, tmp_path, 60), range(2)))
    assert found[0].files == found[1].files
    assert all(images.read(file).shape == (45, 60, 3) for file in found[0].files)
    assert [p.name for p in tmp_path.iterdir()] == [found[0].fingerprint]


def test_size_and_number_of_views_are_in_the_fingerprint() -> None:
    marks = {
        scenes.fingerprint(PROCEDURAL, 60),
        scenes.fingerprint(PROCEDURAL, 64),
        scenes.fingerprint(replace(PROCEDURAL, views=4), 60),
        scenes.fingerprint(SceneConf("motorcycle", "motorcycle"), 60),
    }
    assert len(marks) == 4
    full = scenes.fingerprint(PROCEDURAL, procedural.FULL_SIDE)
    assert scenes.fingerprint(PROCEDURAL, 0) == full


def test_one_view_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match=r"scene\.views=1"):
        scenes.resolve(replace(PROCEDURAL, views=1), tmp_path)


def test_the_motorcycle_calibration_fits_its_disparity(tmp_path: Path) -> None:
    """depth = baseline f / (disparity + cx_right - cx_left): points of the left photograph."""
    scene = scenes.resolve(SceneConf("motorcycle", "motorcycle"), tmp_path)
    assert stems(scene) == ["motorcycle_left", "motorcycle_right"]
    assert images.size(scene.files[0]) == (741, 500)
    disparity = np.load(photograph("motorcycle_disp.npz"))["arr_0"]
    left, right = (images.read(file).mean(-1) for file in scene.files)
    Ks, poses = motorcycle.intrinsics(), motorcycle.viewmats()
    rng, differences, shuffled = np.random.default_rng(0), [], []
    for x, y in zip(rng.integers(150, 700, 400), rng.integers(50, 450, 400), strict=True):
        if not np.isfinite(disparity[y, x]):
            continue
        K_left, K_right = Ks["motorcycle_left"], Ks["motorcycle_right"]
        offset = K_right[0, 2] - K_left[0, 2]
        depth = K_left[0, 0] * 193.001 / (disparity[y, x] + offset)
        point = depth * np.linalg.inv(K_left) @ (x, y, 1)
        seen = K_right @ (
            poses["motorcycle_right"][:3, :3] @ point + poses["motorcycle_right"][:3, 3]
        )
        column, row = seen[:2] / seen[2]
        if not 0 <= column < 740:
            continue
        assert row == pytest.approx(y)
        differences.append(abs(left[y, x] - right[y, round(column)]))
        shuffled.append(abs(left[y, x] - right[y, int(rng.integers(0, 740))]))
    assert len(differences) > 200
    assert np.median(differences) < 0.3 * np.median(shuffled)


@pytest.mark.parametrize("name", [file for file, _ in procedural.TEXTURES.values()])
def test_the_photographs_are_in_the_installed_wheel(name: str) -> None:
    assert images.read(photograph(name)).ndim == 3


def test_a_photograph_that_the_wheel_lacks_is_named() -> None:
    with pytest.raises(XrgsError, match=r"nothing\.png"):
        photograph("nothing.png")


def test_fingerprints_need_neither_torch_nor_scikit_image() -> None:
    script = (
        "import sys; from xrgs.capture import scenes; from xrgs.config import SceneConf;"
        "scenes.fingerprint(SceneConf('p', 'procedural'), 100);"
        "scenes.fingerprint(SceneConf('m', 'motorcycle'));"
        "print(sorted({'torch', 'skimage', 'pycolmap'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
