"""Frames of videos: which are taken, how they are shown, and what is refused."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.photos.scene_confs import scene_conf
from tests.photos.scenes.test_no_photographs import sphere
from xrgs.config import SceneConf
from xrgs.errors import XrgsError
from xrgs.photos import images, scenes
from xrgs.photos.images import ImageError
from xrgs.photos.scenes import video

WIDTH, HEIGHT = 96, 64
#: A fixed-point rotation by a quarter turn, as a phone writes it into the header of a track.
UPRIGHT = b"\0\1\0\0" + bytes(12) + b"\0\1\0\0" + bytes(12) + b"@\0\0\0"
QUARTER_TURN = bytes(4) + b"\0\1\0\0" + bytes(4) + b"\xff\xff\0\0" + bytes(16) + b"@\0\0\0"
#: Colours in sRGB that Display P3 and BT.2020 have too.
PATCHES = [(230, 30, 30), (30, 220, 40), (30, 60, 220), (200,) * 3, (240, 200, 30), (9, 20, 40)]
#: From linear sRGB to linear RGB of these primaries, by ITU-R BT.2087 and by CSS Color 4.
TO_BT2020 = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
TO_P3 = [[0.8225, 0.1775, 0], [0.0332, 0.9668, 0], [0.0171, 0.0724, 0.9105]]
TO_BT601 = [[0.9578, 0.0422, 0], [0, 1, 0], [0, -0.0119, 1.0119]]
TO_SRGB = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
#: The weights of red and blue in luma of BT.601, BT.709 and BT.2020.
BT601, BT709, BT2020 = (0.299, 0.114), (0.2126, 0.0722), (0.2627, 0.0593)


def textured(level: int, blur: int) -> NDArray[np.uint8]:
    """A frame of a brightness that names it, with stripes of a contrast that falls with `blur`."""
    frame = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    frame[:, 8:40:4] += np.uint8(48 >> blur)
    return frame


def write_video(
    file: Path,
    frames: Sequence[NDArray[np.uint8]],
    codec: str = "mpeg4",
    pixels: tuple[str, str] = ("rgb24", "yuv420p"),
    colours: tuple[int, int, int] = (2, 2, 2),
    aspect: Fraction = Fraction(1),
    options: dict[str, str] | None = None,
) -> None:
    """Write a video.

    Args:
        file: The video.
        frames: Its frames.
        codec: FFmpeg's name of the codec.
        pixels: The formats of the frames, and of the video.
        colours: Primaries, curve and matrix by ITU-T H.273.
        aspect: Width by height of a pixel.
        options: Options of the codec.
    """
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels[1]
        stream.bit_rate = 4_000_000
        stream.options = options or {}
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace = colours
        context.sample_aspect_ratio = aspect
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=pixels[0])))
        container.mux(stream.encode(None))


def turn(file: Path, matrix: bytes = QUARTER_TURN) -> None:
    """Write a matrix, else a quarter turn clockwise, into the header of an MP4."""
    content = file.read_bytes()
    at = content.index(UPRIGHT, content.index(b"tkhd"))
    file.write_bytes(content[:at] + matrix + content[at + len(UPRIGHT) :])


def patches(
    to_primaries: Sequence[Sequence[float]], luma: tuple[float, float]
) -> NDArray[np.uint8]:
    """Stripes of `PATCHES` with sRGB's curve, as 4:2:0 of limited range [HEIGHT * 3 / 2, WIDTH]."""
    srgb = np.array(PATCHES) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    linear = linear @ np.transpose(to_primaries)
    red, green, blue = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055
    ).T
    of_red, of_blue = luma
    y = of_red * red + (1 - of_red - of_blue) * green + of_blue * blue
    u, v = (blue - y) / (2 - 2 * of_blue), (red - y) / (2 - 2 * of_red)
    stripe = WIDTH // len(PATCHES)
    planes = [
        np.tile(np.repeat(np.round(16 + 219 * y), stripe), HEIGHT),
        *(np.tile(np.repeat(np.round(128 + 224 * c), stripe // 2), HEIGHT // 2) for c in (u, v)),
    ]
    return np.concatenate(planes).reshape(-1, WIDTH).astype(np.uint8)


def disc(radius: float, aspect: Fraction) -> NDArray[np.uint8]:
    """A frame with a white disc in its middle, as a camera of pixels of an aspect stores it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    wide, high = max(aspect, Fraction(1)), max(1 / aspect, Fraction(1))
    distance = np.hypot((x - WIDTH / 2) * float(wide), (y - HEIGHT / 2) * float(high))
    edge = np.clip(radius + 0.5 - distance, 0, 1)
    return np.repeat(np.round(235 * edge[..., None]).astype(np.uint8), 3, axis=2)


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


@pytest.mark.parametrize(
    ("a", "b", "c", "d"),
    [case for i, j in itertools.product((1, -1), (1, -1)) for case in ((i, 0, 0, j), (0, i, j, 0))],
)
def test_a_video_is_turned_and_mirrored_by_its_matrix(
    tmp_path: Path, a: int, b: int, c: int, d: int
) -> None:
    """QuickTime's format shows the pixel (x, y) at (ax + cy, bx + dy), and moves it into view."""
    frame = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    frame[: HEIGHT // 2, : WIDTH // 2] = 200
    write_video(tmp_path / "a.mp4", [frame, frame])
    values = (a, b, 0, c, d, 0, 0, 0, 1 << 14)
    turn(tmp_path / "a.mp4", b"".join((v << 16).to_bytes(4, "big", signed=True) for v in values))
    scene = scenes.resolve(conf(tmp_path / "a.mp4", 2), tmp_path)
    image = images.read(scene.files["frame_0000"])
    right, down = -a - c > 0, -b - d > 0  # the bright quarter is at the top left in the file
    height, width = image.shape[:2]
    assert (height, width) == ((WIDTH, HEIGHT) if b else (HEIGHT, WIDTH))
    y, x = height * (1 + 2 * down) // 4, width * (1 + 2 * right) // 4
    assert image[y, x].mean() * 255 == pytest.approx(200, abs=6)
    assert image[height - y, width - x].mean() * 255 == pytest.approx(60, abs=6)


@pytest.mark.parametrize(
    ("colours", "to_primaries", "luma"),
    [
        ((2, 2, 2), TO_SRGB, BT601),
        ((5, 6, 5), TO_BT601, BT601),
        ((12, 13, 1), TO_P3, BT709),
        ((9, 14, 9), TO_BT2020, BT2020),
    ],
    ids=["unspecified", "BT.601", "Display P3", "BT.2020"],
)
def test_colours_are_converted_to_srgb(
    tmp_path: Path,
    colours: tuple[int, int, int],
    to_primaries: list[list[float]],
    luma: tuple[float, float],
) -> None:
    frame = patches(to_primaries, luma)
    write_video(tmp_path / "a.mkv", [frame] * 2, "ffv1", ("yuv420p", "yuv420p"), colours)
    scene = scenes.resolve(conf(tmp_path / "a.mkv", 2), tmp_path)
    stripe = WIDTH // len(PATCHES)
    middles = images.read(scene.files["frame_0000"])[HEIGHT // 2, stripe // 2 :: stripe] * 255
    assert np.abs(middles - PATCHES).max() <= 4  # 8 bits of YUV, and of RGB in between


def moving(frames: int) -> list[NDArray[np.uint8]]:
    """Frames of smooth waves that move by three pixels each."""
    y, x = np.mgrid[:HEIGHT, : WIDTH + 3 * frames]
    waves = np.sin(x / 3 + y / 7) + np.sin(x / 5 - y / 4) + np.sin(x / 11 + y / 3)
    picture = np.repeat((128 + 36 * waves).round().astype(np.uint8)[..., None], 3, axis=2)
    return [picture[:, 3 * i : 3 * i + WIDTH] for i in range(frames)]


def woven(fields: Sequence[NDArray[np.uint8]], first: int) -> list[NDArray[np.uint8]]:
    """Frames of two pictures each, the lines of the first of which begin at line `first`."""
    frames = []
    for early, late in zip(fields[::2], fields[1::2], strict=True):
        frame = late.copy()
        frame[first::2] = early[first::2]
        frames.append(frame)
    return frames


@pytest.mark.parametrize(("first", "flags"), [(0, ""), (1, "bff=1:interlaced=1")])
def test_interlaced_frames_are_shown_deinterlaced(tmp_path: Path, first: int, flags: str) -> None:
    """Whether the video marks them, and which field is the first."""
    fields = moving(40)
    options = {"crf": "6", "x264-params": flags}
    write_video(tmp_path / "a.mp4", woven(fields, first), "libx264", options=options)
    scene = scenes.resolve(conf(tmp_path / "a.mp4", 20), tmp_path)
    for number, file in enumerate(scene.files.values()):
        shown = images.read(file)[4:-4, 4:-4] * 255
        errors = [np.abs(shown - field[4:-4, 4:-4]).mean() for field in fields]
        assert min(errors) < 4, number
        assert np.argmin(errors) // 2 == number


@pytest.mark.parametrize("step", [0, 3])
def test_progressive_frames_stay_as_they_are(tmp_path: Path, step: int) -> None:
    frames = [moving(1)[0]] * 9 if step == 0 else moving(10 * step)[::step]
    pixels = ("gray8", "gray8")
    write_video(tmp_path / "a.mkv", [frame[..., 0] for frame in frames], "ffv1", pixels)
    scene = scenes.resolve(conf(tmp_path / "a.mkv", len(frames)), tmp_path)
    for frame, file in zip(frames, scene.files.values(), strict=True):
        assert np.abs(images.read(file) * 255 - frame).max() <= 1


def test_hdr_is_refused_as_in_photographs(tmp_path: Path) -> None:
    colours = (9, 16, 9)
    frames = [textured(90, 0)] * 2
    write_video(tmp_path / "a.mp4", frames, colours=colours)
    write_video(tmp_path / "b.avi", frames, "libx264", colours=colours)  # it says so in the stream
    # The decoder of this one forgets what the container says.
    write_video(tmp_path / "c.mov", frames, "prores_ks", ("rgb24", "yuv422p10le"), colours)
    for file in ("a.mp4", "b.avi", "c.mov"):
        with pytest.raises(ImageError) as caught:
            scenes.resolve(conf(tmp_path / file, 2), tmp_path)
        assert f"{file}: its brightness is HDR (PQ); save it as SDR" in str(caught.value)


@pytest.mark.parametrize(
    ("aspect", "is_turned"), [(Fraction(4, 3), True), (Fraction(8, 9), False)], ids=str
)
def test_a_disc_of_oblong_pixels_is_shown_round(
    tmp_path: Path, aspect: Fraction, is_turned: bool
) -> None:
    write_video(tmp_path / "a.mp4", [disc(24, aspect)] * 2, aspect=aspect)
    size = (64, 128) if aspect > 1 else (72, 96)
    if is_turned:
        turn(tmp_path / "a.mp4")
        size = size[::-1]
    scene = scenes.resolve(conf(tmp_path / "a.mp4", 2), tmp_path)
    image = images.read(scene.files["frame_0000"])
    assert image.shape == (*size, 3)
    weight = image[..., 1] * (255 / 235)
    assert weight.sum() == pytest.approx(np.pi * 24**2, rel=0.02)
    for axis, length in enumerate(size):
        across = weight.sum(axis=1 - axis)
        position = np.arange(length) + 0.5 - length / 2
        assert across @ position / across.sum() == pytest.approx(0, abs=0.1)
        # The mean square of a coordinate in a disc is a quarter of its squared radius.
        assert across @ position**2 / across.sum() == pytest.approx(24**2 / 4, rel=0.03)


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
    with pytest.raises(XrgsError, match=r"is a folder, and no video; scene=folder takes it"):
        scenes.fingerprint(conf(tmp_path, 2))
    with pytest.raises(XrgsError, match=r"not a folder; .*scene=video"):
        scenes.fingerprint(scene_conf("folder", tmp_path / "a.mp4"))
    monkeypatch.setattr(video, "find_spec", lambda _: None)
    with pytest.raises(XrgsError, match=r"pip install 'xrgs\[video\]'"):
        scenes.fingerprint(conf(tmp_path / "a.mp4", 2))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"twelve bytes", r"unreadable as a video"),
        (b"", r"unreadable as a video"),
        ("large", r"its frames have 192 x 64 pixels, too many"),
        ("sound", r"it has no video"),
    ],
)
def test_a_file_that_cannot_be_a_video_is_named_before_frames_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | str, why: str
) -> None:
    """As in a dry run, which asks for names, and with the words of the reader."""
    file = tmp_path / "a.mkv"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content == "sound":
        with av.open(str(file), "w") as container:
            stream = container.add_stream("pcm_s16le", rate=8000)
            sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
            sound.rate = 8000
            container.mux(stream.encode(sound))
            container.mux(stream.encode(None))
    else:
        write_video(file, [textured(9, 0)] * 2, aspect=Fraction(2))
        monkeypatch.setattr(images, "MAX_PIXELS", WIDTH * HEIGHT)
    with pytest.raises(XrgsError, match=rf"a\.mkv: {why}") as refused:
        scenes.names(conf(file, 2))
    with pytest.raises(XrgsError) as read:
        video.extract(file, ["frame_0000", "frame_0001"], tmp_path)
    assert str(read.value) == str(refused.value)


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
    assert video.sharpest([1, 1, 1, 1, 1, 2, 0], 3) == [0, 2, 5]  # the first of equals
    assert video.measure_sharpness(np.full((20, 20), 7, np.uint8)) == 0


def write_streams(file: Path, *pictures: NDArray[np.uint8]) -> None:
    """Write a video of four frames without loss, with a stream of each picture."""
    with av.open(str(file), "w") as container:
        streams = [container.add_stream("ffv1", rate=Fraction(10)) for _ in pictures]
        for stream, picture in zip(streams, pictures, strict=True):
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "yuv420p"
        for stream, picture in zip(streams, pictures, strict=True):
            for _ in range(4):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode(None))


def test_the_first_of_several_streams_is_taken_and_said(tmp_path: Path) -> None:
    write_streams(tmp_path / "a.mkv", textured(200, 9), textured(60, 9))
    scene = scenes.resolve(conf(tmp_path / "a.mkv", 2), tmp_path)
    assert scene.notes == ("the first of the 2 video streams of a.mkv is read, and no other",)
    brightness = images.read(scene.files["frame_0000"])[50:].mean() * 255
    assert brightness == pytest.approx(200, abs=6)
    write_streams(tmp_path / "b.mkv", textured(90, 0))
    assert scenes.resolve(conf(tmp_path / "b.mkv", 2), tmp_path).notes == ()


def test_a_video_of_all_directions_is_refused(tmp_path: Path) -> None:
    write_streams(tmp_path / "a.mkv", sphere(1, 64))
    with pytest.raises(ImageError, match=r"a\.mkv: its frames show all directions, 360 degrees"):
        scenes.resolve(conf(tmp_path / "a.mkv", 2), tmp_path)


def test_the_colours_of_large_videos_that_name_none_are_those_that_players_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """BT.709's from 720 rows on, as in Chromium, and BT.601's below."""
    middles = []
    for height in (718, 720):
        monkeypatch.setattr(f"{__name__}.HEIGHT", height)
        write_video(
            tmp_path / f"{height}.mkv",
            [patches(TO_SRGB, BT709 if height >= 720 else BT601)] * 2,
            "ffv1",
            ("yuv420p", "yuv420p"),
        )
        scene = scenes.resolve(conf(tmp_path / f"{height}.mkv", 2), tmp_path / str(height))
        middles.append(images.read(scene.files["frame_0000"])[height // 2, 8::16] * 255)
    assert np.abs(np.array(middles) - PATCHES).max() <= 4


def test_the_aspect_may_be_in_the_stream_alone(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [disc(24, Fraction(2))] * 2, aspect=Fraction(2))
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.count(b"pasp") == 1
    (tmp_path / "a.mp4").write_bytes(content.replace(b"pasp", b"free"))
    scene = scenes.resolve(conf(tmp_path / "a.mp4", 2), tmp_path)
    assert images.size(scene.files["frame_0000"]) == (2 * WIDTH, HEIGHT)
