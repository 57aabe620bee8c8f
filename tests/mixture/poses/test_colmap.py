"""Models of COLMAP against pycolmap's writer, and files that were cut, edited and thinned."""

from __future__ import annotations

import struct
import tracemalloc
import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from tests.mixture.poses.written import NAMES, PARAMS, POINTS, SIZE, project, viewmat, write_colmap
from xrgs.errors import XrgsError
from xrgs.mixture.poses import colmap
from xrgs.photos.lens import MODELS

STORED = (102, 76)
FORMS = ("binary", "text")


@pytest.mark.parametrize("model", [name for name in MODELS if name != "EQUIRECTANGULAR"])
def test_every_camera_model_is_read(tmp_path: Path, model: str) -> None:
    count = len(MODELS[model])
    params = (*((150.0,) if MODELS[model][0] == "f" else (150.0, 140.0)), 104.0, 75.0)
    params += tuple(0.25 + 0.125 * i for i in range(count - len(params)))
    given = colmap.read(write_colmap(tmp_path / "a", model, params))
    lens, matrix = given.camera(NAMES[1], STORED)
    assert (lens.width, lens.height) == SIZE
    assert np.allclose(matrix, viewmat(1), atol=1e-9)
    cam = pycolmap.Camera(model=model, width=1, height=1, params=params)
    rays = np.array([[0.1, -0.2], [0.3, 0.1]])
    assert lens.project(rays) == pytest.approx(cam.img_from_cam(np.c_[rays, [1, 1]]), abs=1e-4)


def with_features(folder: Path, *, form: str = "binary") -> Path:
    """Write a model in which image i sees the points from i on, and has a feature of no point."""
    model = pycolmap.Reconstruction(write_colmap(folder / "bare"))
    numbers = sorted(model.points3D)
    for image in model.images.values():
        features = [pycolmap.Point2D(np.array([5.0, 6.0]))]
        features += [pycolmap.Point2D(np.array([1.0, n])) for n in numbers[image.image_id :]]
        image.points2D = pycolmap.Point2DList(features)
    for image in model.images.values():
        for place, n in enumerate(numbers[image.image_id :], 1):
            model.add_observation(n, pycolmap.TrackElement(image.image_id, place))
    for n in numbers:
        model.points3D[n].error = 0.25 * n
    (model.write_binary if form == "binary" else model.write_text)(folder)
    return folder


@pytest.mark.parametrize("form", FORMS)
def test_what_images_observe_is_read(tmp_path: Path, form: str) -> None:
    given = colmap.read(with_features(tmp_path, form=form))
    assert np.allclose(given.points, POINTS)
    assert (given.colors == (10, 20, 30)).all()
    for i, name in enumerate(NAMES):
        assert given.observed[name].tolist() == list(range(i + 1, len(POINTS)))
    # The features are at x = 1 and y = the point's number, and not near their points; the errors
    # that the model stores are of neither. COLMAP averages for each point first.
    seen_in = [np.arange(i + 1, len(POINTS)) for i in range(len(NAMES))]
    off = np.full((len(NAMES), len(POINTS)), np.nan)
    for i, points in enumerate(seen_in):
        off[i, points] = np.hypot(*(project(i)[points] - np.c_[points * 0 + 1, points + 1]).T)
    assert given.report == {
        "reprojection_error_px": pytest.approx(np.nanmean(np.nanmean(off[:, 1:], axis=0)))
    }
    assert given.notes == []


def test_points_behind_their_cameras_are_counted(tmp_path: Path) -> None:
    """All of an image whose optical axis was turned round; the mean is of the others."""
    model = pycolmap.Reconstruction(with_features(tmp_path))
    turn = pycolmap.Rigid3d(np.c_[np.diag([-1.0, 1.0, -1.0]), [0, 0, 0]])
    model.images[3].frame.rig_from_world = turn * model.images[3].cam_from_world()
    (tmp_path / "turned").mkdir()
    model.write_binary(tmp_path / "turned")
    given = colmap.read(tmp_path / "turned")
    assert ["9 of 30 observations" in note for note in given.notes] == [True]
    off = np.full((2, len(POINTS)), np.nan)
    for i in range(2):
        points = np.arange(i + 1, len(POINTS))
        off[i, points] = np.hypot(*(project(i)[points] - np.c_[points * 0 + 1, points + 1]).T)
    mean = np.nanmean(np.nanmean(off[:, 1:], axis=0))
    assert given.report == {"reprojection_error_px": pytest.approx(mean)}


def test_points_that_were_filtered_are_not_observed(tmp_path: Path) -> None:
    folder = with_features(tmp_path)
    data = struct.pack("<Q", len(POINTS[::2]))
    for i, xyz in enumerate(POINTS[::2]):  # the points keep their numbers: 1, 3, 5 and so on
        data += struct.pack("<Q3d3BdQ", 2 * i + 1, *xyz, 1, 2, 3, 0.5, 0)
    (folder / "points3D.bin").write_bytes(data)
    given = colmap.read(folder)
    assert np.allclose(given.points, POINTS[::2])
    assert given.observed[NAMES[0]].tolist() == [1, 2, 3, 4, 5]


def test_a_rig_with_frames_is_read_as_pycolmap_reads_it(tmp_path: Path) -> None:
    """Two cameras on a rig, three frames: the poses are of frame and of the rig together."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for number in (1, 2):
        camera = pycolmap.Camera(
            camera_id=number, model="PINHOLE", width=SIZE[0], height=SIZE[1], params=PARAMS
        )
        model.add_camera(camera)
    rig.add_ref_sensor(model.cameras[1].sensor_id)
    turn = pycolmap.Rotation3d(np.array([0.0, 0.5, 0.1]))
    rig.add_sensor(model.cameras[2].sensor_id, pycolmap.Rigid3d(turn, np.array([0.3, 0.0, 0.1])))
    model.add_rig(rig)
    expected = {}
    for f in range(3):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        frame.rig_from_world = pycolmap.Rigid3d(viewmat(f)[:3])
        numbers = [2 * f + 1, 2 * f + 2]
        for number, camera in zip(numbers, (1, 2), strict=True):
            frame.add_data_id(pycolmap.data_t(model.cameras[camera].sensor_id, number))
        model.add_frame(frame)
        for number, camera in zip(numbers, (1, 2), strict=True):
            name = f"cam{camera}/{f}.jpg"
            model.add_image(
                pycolmap.Image(name=name, camera_id=camera, image_id=number, frame_id=f + 1)
            )
        model.register_frame(f + 1)
    for image in model.images.values():
        expected[image.name] = image.cam_from_world().matrix()
    for form in FORMS:
        folder = tmp_path / form
        folder.mkdir()
        (model.write_binary if form == "binary" else model.write_text)(folder)
        given = colmap.read(folder)
        assert sorted(given.names) == sorted(expected)
        for name, matrix in expected.items():
            assert np.allclose(given.camera(name, STORED)[1][:3], matrix, atol=1e-9)


def edited(folder: Path, file: str, change: Callable[[list[str]], list[str]]) -> Path:
    """Write a text model and change the lines of one file, without its comments."""
    write_colmap(folder, text=True)
    lines = [x for x in (folder / file).read_text().split("\n") if not x.startswith("#")]
    (folder / file).write_text("\n".join(change(lines)))
    return folder


def words(line: int, changes: dict[int, str]) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        parts = lines[line].split(" ")
        lines[line] = " ".join(changes.get(i, part) for i, part in enumerate(parts))
        return lines

    return change


def test_names_with_spaces_are_read_whole(tmp_path: Path) -> None:
    folder = edited(tmp_path / "a", "images.txt", words(2, {9: "DJI 1 2.jpg"}))
    given = colmap.read(folder)
    assert given.names == [NAMES[0], "DJI 1 2.jpg", NAMES[2]]


def test_text_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    """As editors of Windows write it, before a comment and before an entry."""
    folder = edited(tmp_path / "a", "images.txt", lambda lines: ["\ufeff" + lines[0], *lines[1:]])
    cameras = folder / "cameras.txt"
    cameras.write_bytes(b"\xef\xbb\xbf# edited\n" + cameras.read_bytes())
    assert colmap.read(folder).names == list(NAMES)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("images.txt", words(2, dict.fromkeys(range(1, 5), "0")), "day1/b.jpg: its quaternion"),
        ("images.txt", words(2, {6: "nan"}), "day1/b.jpg: its pose must have finite numbers"),
        ("images.txt", words(2, {9: NAMES[0]}), "images 1 and 2 have one name, day1/a.jpg"),
        ("images.txt", words(2, {8: "7"}), "day1/b.jpg has camera 7, which is missing"),
        ("images.txt", lambda x: [x[0], *x[2:]], "line 2 must be X Y POINT3D_ID of each feature"),
        ("cameras.txt", words(0, {4: "-5"}), "focal length must be above 0"),
        ("cameras.txt", words(0, {1: "GLASS"}), "camera model GLASS: must be one of"),
        ("cameras.txt", words(0, {2: "wide"}), "line 1 must be CAMERA_ID MODEL"),
        ("points3D.txt", words(3, {2: "x"}), "line 4 must be POINT3D_ID X Y Z"),
    ],
)
def test_a_line_that_is_wrong_is_named(
    tmp_path: Path, file: str, change: Callable[[list[str]], list[str]], message: str
) -> None:
    folder = edited(tmp_path / "a", file, change)

    def read_all() -> None:
        given = colmap.read(folder)
        for name in given.names:
            given.camera(name, STORED)

    with pytest.raises(XrgsError, match=message):
        read_all()


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_file_that_was_cut_is_named(tmp_path: Path, file: str) -> None:
    folder = with_features(tmp_path)
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(content[:-1])
    with pytest.raises(XrgsError, match=rf"/{file}: it ends after .* it was cut"):
        colmap.read(folder)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_count_takes_no_memory(tmp_path: Path, file: str) -> None:
    folder, count = with_features(tmp_path), 2**40
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(struct.pack("<Q", count) + content[8:])
    tracemalloc.start()
    with pytest.raises(XrgsError, match=rf"/{file}: .* within {count} entries: it was cut"):
        colmap.read(folder)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_more_bytes_than_entries_and_unknown_models_are_named(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "a")
    cameras = folder / "cameras.bin"
    content = cameras.read_bytes()
    cameras.write_bytes(content + b"12345")
    with pytest.raises(XrgsError, match=r"cameras\.bin: 5 bytes are left after its last entry"):
        colmap.read(folder)
    cameras.write_bytes(content[:12] + struct.pack("<i", 77) + content[16:])
    with pytest.raises(XrgsError, match="camera 1 has the model number 77, not known here"):
        colmap.read(folder)


@pytest.mark.parametrize(("below", "form"), [("", "text"), ("sparse", "binary")])
def test_of_several_models_the_one_of_most_images_is_taken(
    tmp_path: Path, below: str, form: str
) -> None:
    folder = tmp_path / below
    for name, count in (("0", 2), ("1", 3), ("2", 1)):
        write_colmap(folder / name, names=NAMES[:count], text=form == "text")
    given = colmap.read(tmp_path)
    assert len(given.names) == 3
    inside = f"{below}/" if below else ""
    (note,) = given.notes
    assert f"{inside}1 (3 images) is taken, and not {inside}0 (2 images), {inside}2 (1" in note
    assert [file.parent for file in colmap.files(tmp_path)] == [folder / "1"] * 3


def test_binary_files_are_preferred_and_a_model_may_have_no_points(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "a", text=True)
    text = ["cameras.txt", "images.txt", "points3D.txt"]
    assert [file.name for file in colmap.files(folder)] == text
    for file in write_colmap(tmp_path / "b").iterdir():
        file.rename(folder / file.name)
    assert {file.suffix for file in colmap.files(folder)} == {".bin"}
    (folder / "points3D.bin").unlink()
    assert [file.name for file in colmap.files(folder)] == text
    (folder / "images.txt").unlink()
    assert [file.name for file in colmap.files(folder)] == ["cameras.bin", "images.bin"]
    assert len(colmap.read(folder).points) == 0
    (folder / "images.bin").unlink()
    assert colmap.files(folder) == []


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_quaternions_of_few_digits_or_another_length_are_rotations(
    tmp_path: Path, scale: float
) -> None:
    quat = pycolmap.Rotation3d(viewmat(1)[:3, :3]).quat * scale
    digits = {1 + i: f"{quat[(i + 3) % 4]:.4g}" for i in range(4)}
    folder = edited(tmp_path / "a", "images.txt", words(2, digits))
    matrix = colmap.read(folder).camera(NAMES[1], STORED)[1]
    assert np.abs(matrix - viewmat(1)).max() < 3e-4
    assert matrix[:3, :3] @ matrix[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
