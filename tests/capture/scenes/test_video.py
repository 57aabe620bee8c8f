"""Frames of videos: which are taken, how they are turned, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.capture.scene_confs import scene_conf
from xrgs.capture import images, scenes
from xrgs.capture.images import ImageError
from xrgs.capture.scenes import video
from xrgs.config import SceneConf
from xrgs.errors import XrgsError

WIDTH, HEIGHT = 96, 64
#: A fixed-point rotation by a quarter turn, as a phone writes it into the header of a track.
UPRIGHT = b"\0\1\0\0" + bytes(12) + b"\0\1\0\0" + bytes(12) + b"@\0\0\0"
QUARTER_TURN = bytes(4) + b"\0\1\0\0" + bytes(4) + b"\xff\xff\0\0" + bytes(16) + b"@\0\0\0"


def textured(level: int, blur: int) -> NDArray[np.uint8]:
    """A frame of a brightness that names it, with stripes of a contrast that falls with `blur`."""
    frame = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    frame[8:40:4] += np.uint8(48 >> blur)
    return frame


def write_video(file: Path, frames: Sequence[NDArray[np.uint8]]) -> None:
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.bit_rate = 4_000_000
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))


def conf(file: Path, views: int) -> SceneConf:
    return scene_conf("video", file, views=views)


def test_the_sharpest_frame_of_each_part_is_taken(tmp_path: Path) -> None:
    levels = [20 * i for i in range(9)]
    write_video(tmp_path / "a.mp4", [textured(x, blur=i % 3 != 1) for i, x in enumerate(levels)])
    scene = scenes.resolve(conf(tmp_path / "a.mp4", 3), tmp_path)
    assert list(scene.files) == ["frame_0000", "frame_0001", "frame_0002"]
    brightness = [images.read(file)[50:].mean() * 255 for file in scene.files.values()]
    assert brightness == pytest.approx([levels[1], levels[4], levels[7]], abs=6)
    assert scene.name == "a.mp4"


def test_the_identity_is_the_content_and_the_number_of_frames(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [textured(90, 0), textured(99, 0), textured(80, 0)])
    (tmp_path / "b.mov").write_bytes((tmp_path / "a.mp4").read_bytes())
    write_video(tmp_path / "c.mp4", [textured(91, 0), textured(99, 0), textured(80, 0)])
    keys = [scenes.fingerprint(conf(tmp_path / name, 2)) for name in ("a.mp4", "b.mov", "c.mp4")]
    assert keys[0] == keys[1]
    assert len({*keys, scenes.fingerprint(conf(tmp_path / "a.mp4", 3))}) == 3


def test_a_video_held_upright_is_turned_as_a_player_does(tmp_path: Path) -> None:
    frame = textured(60, 0)
    frame[:, : WIDTH // 2] = 200  # bright on the left; a quarter turn clockwise puts it on top
    write_video(tmp_path / "a.mp4", [frame, frame])
    content = (tmp_path / "a.mp4").read_bytes()
    header = content.index(b"tkhd")
    at = content.index(UPRIGHT, header)
    turned = content[:at] + QUARTER_TURN + content[at + len(UPRIGHT) :]
    (tmp_path / "b.mp4").write_bytes(turned)
    scene = scenes.resolve(conf(tmp_path / "b.mp4", 2), tmp_path)
    image = images.read(scene.files["frame_0000"])
    assert image.shape == (WIDTH, HEIGHT, 3)
    assert image[: WIDTH // 3].mean() * 255 == pytest.approx(200, abs=6)
    assert image[-WIDTH // 3 :].mean() * 255 < 100


def test_too_few_frames_no_video_and_no_package_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_video(tmp_path / "a.mp4", [textured(90, 0), textured(99, 0)])
    with pytest.raises(XrgsError, match=r"scene\.views=3: .*a\.mp4 has 2 frames"):
        scenes.resolve(conf(tmp_path / "a.mp4", 3), tmp_path)
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXTINF:1,\na.mp4\n#EXT-X-ENDLIST\n")
    with pytest.raises(ImageError, match=r"list\.mp4: unreadable as a video"):
        scenes.resolve(conf(tmp_path / "list.mp4", 2), tmp_path)
    with pytest.raises(XrgsError, match=r"scene\.path=.*gone\.mp4: No such file"):
        scenes.fingerprint(conf(tmp_path / "gone.mp4", 2))
    with pytest.raises(XrgsError, match=r"not a folder; .*scene=video"):
        scenes.fingerprint(scene_conf("folder", tmp_path / "a.mp4"))
    monkeypatch.setattr(video, "find_spec", lambda _: None)
    with pytest.raises(XrgsError, match=r"pip install 'xrgs\[video\]'"):
        scenes.fingerprint(conf(tmp_path / "a.mp4", 2))


def test_a_truncated_video_gives_the_frames_that_it_has(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", [textured(10 * i, 0) for i in range(20)])
    content = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "b.avi").write_bytes(content[: len(content) // 2])
    scene = scenes.resolve(conf(tmp_path / "b.avi", 2), tmp_path)
    assert all(images.size(file) == (WIDTH, HEIGHT) for file in scene.files.values())


def test_sharpness_is_that_of_the_laplacian() -> None:
    """A checkerboard of 0 and 2: the Laplacian is 8 or -8 inside, of variance 64."""
    board = 2 * (np.indices((20, 20)).sum(0) % 2).astype(np.uint8)
    inner = video.measure_sharpness(np.pad(board, 0))
    assert inner == pytest.approx(64, rel=0.2)
    assert video.measure_sharpness(np.full((20, 20), 7, np.uint8)) == 0


def test_parts_are_equal_and_the_first_of_equals_is_taken() -> None:
    assert video.sharpest([1, 1, 1, 1, 1, 2, 0], 3) == [0, 2, 5]
