"""Takes the sharpest frames of a video, evenly spread, as the photographs of a scene.

The frames are divided into `scene.views` equal parts, and the sharpest of each part is taken.
Sharpness is the variance of the Laplacian of the brightness [pechpacheco2000], at a reduced size,
at which the noise of the sensor counts little. Frames are taken as a player shows them: with
square pixels, upright, deinterlaced and in sRGB. HDR is refused, as in photographs. Nothing here
imports av before frames are read.

The frames of an interlaced video are woven of two fields that were taken one after the other.
Moving things in them have combed edges, which would count as sharpness. Frames that the video marks
as interlaced are deinterlaced by FFmpeg's `bwdif`, as in a player. If it marks none, `idet`
compares the lines of each frame with its neighbours, and marks those of two fields.
"""

from __future__ import annotations

import logging
import struct
from contextlib import closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from importlib.util import find_spec
from itertools import chain, groupby, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.errors import UnreadableError, XrgsError
from xrgs.photos import colour, images
from xrgs.photos.scenes import rendered
from xrgs.photos.scenes.no_photographs import is_of_all_directions
from xrgs.photos.scenes.scene import Scene, check_views, label
from xrgs.runtime.progress import ProgressBar
from xrgs.safeio.files import is_transient
from xrgs.safeio.hashing import digest, file_digest
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Sequence

    from av.container import InputContainer
    from av.filter.graph import Graph
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream
    from numpy.typing import NDArray

    from xrgs.config import SceneConf


_log = logging.getLogger(__name__)

#: The longer side at which sharpness is measured, px; our choice.
_SHARPNESS_SIDE = 640
#: The containers that are read, by FFmpeg's names. Others, such as playlists, lead to other files.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg"
#: H.273's number of an unnamed matrix. For it players take BT.709's from this many rows on, and
#: BT.601's for smaller frames.
_UNKNOWN_MATRIX, _HD_ROWS = 2, 720
#: `idet` leaves its first frames undecided, so this many frames are fed to it twice.
_WARM_UP = 12
#: `idet` marks a frame if one field differs this many times more from the frame before it than the
#: other field does. FFmpeg's own 1.04 marks frames of a camera that moves slowly; our choice.
_LEAST_RATIO = 1.2
_TIME_BASE = Fraction(1, 25)


@dataclass(frozen=True)
class _Frame:
    """A decoded frame, and how a player shows it."""

    decoded: VideoFrame
    encoding: colour.Encoding | None
    """The colours that the video names; None if they are sRGB's or not named."""
    size: tuple[int, int]
    """Width and height with square pixels, before it is turned, px."""


@dataclass(frozen=True)
class VideoScene:
    """The sharpest frames of a video, which are extracted once."""

    code: Callable[[str], str]
    """Returns the digest of the code of a kind of scenes."""

    def names(self, conf: SceneConf, long_side: int) -> list[str]:  # noqa: ARG002
        """Return the names of the frames: `frame_0000`, `frame_0001`, ...

        The first frames are decoded, so that a dry run refuses what is not a video. `digest` names
        a missing file or package.

        Raises:
            ImageError: The file is not a video, or not one that can be taken, see `extract`.
            XrgsError: It has no frame, or `scene.views` is below two.
        """
        check_views(conf)
        file = _file(conf.path)
        if file.is_file() and find_spec("av") is not None:
            with closing(_frames(file)) as frames:
                if next(frames, None) is None:
                    raise _too_few(file, 0, conf.views)
        return [f"frame_{index:04d}" for index in range(conf.views)]

    def digest(self, conf: SceneConf, long_side: int) -> str:  # noqa: ARG002
        """Hash the video's bytes, the number of frames and the source code.

        Raises:
            UnreadableError: The video can't be read now.
            XrgsError: There is no such file, or the package that reads videos is not installed.
        """
        check_views(conf)
        file = _file(conf.path)
        try:
            content = file_digest(file)
        except OSError as error:
            kind = UnreadableError if is_transient(error) else XrgsError
            raise kind(f"scene.path={file}: {error.strerror}") from error
        if find_spec("av") is None:
            raise XrgsError(f"scene.path={file}: a video needs PyAV: pip install 'xrgs[video]'")
        return digest([content, conf.views, self.code("video")])

    def resolve(self, conf: SceneConf, long_side: int, home: Path) -> Scene:
        """Extract the frames, unless they are there."""
        views, file = self.names(conf, long_side), _file(conf.path)
        files = rendered.provide(home, views, lambda work: extract(file, views, work))
        return Scene(label(conf), home.name, files, notes=_notes(file))


def _notes(file: Path) -> tuple[str, ...]:
    """Note that only the first of several streams is read; no note if the video is gone."""
    import av

    try:
        with _opened(file) as container:
            count = len(_streams(container))
    except (av.FFmpegError, OSError):
        return ()
    if count < 2:
        return ()
    return (f"the first of the {count} video streams of {file.name} is read, and no other",)


@contextmanager
def _opened(file: Path) -> Iterator[InputContainer]:
    import av

    with (
        file.open("rb") as stream,
        av.open(stream, "r", options={"format_whitelist": _CONTAINERS}) as container,
    ):
        yield container


def _streams(container: InputContainer) -> list[VideoStream]:
    """Return the video streams of a file, without cover pictures."""
    from av.stream import Disposition

    cover = Disposition.attached_pic
    return [one for one in container.streams.video if not one.disposition & cover]


def _file(path: str | None) -> Path:
    if not path:
        raise XrgsError("scene.path is empty: give the video, scene.path=...")
    file = user_path(path)
    if file.is_dir():
        raise XrgsError(f"scene.path={file}: is a folder, and no video; scene=folder takes it")
    return file


def extract(file: Path, names: Sequence[str], folder: Path) -> None:
    """Write the sharpest frames of a video as `<name>.png` to a folder, as a player shows them.

    Raises:
        ImageError: The file is not a video, it is HDR or of 360 degrees, or its frames are too
            large.
        XrgsError: It has fewer frames than names.
    """
    with ProgressBar("sharpness of frames", "frame", None) as bar:
        sharpness = []
        for frame in _frames(file):
            sharpness.append(measure_sharpness(_brightness(frame.decoded)))
            bar.update(1)
    if len(sharpness) < len(names):
        raise _too_few(file, len(sharpness), len(names))
    chosen = dict(zip(sharpest(sharpness, len(names)), names, strict=True))
    with ProgressBar("frames", "frame", len(names)) as bar:
        for number, frame in enumerate(_frames(file)):
            if number in chosen:
                image = _shown(frame)
                if is_of_all_directions(image.shape[1::-1], partial(images.small, image)):
                    raise images.ImageError(
                        f"{file}: its frames show all directions, 360 degrees, and no pinhole "
                        "camera took them; cut them into perspective views first"
                    )
                images.save(folder / f"{chosen[number]}.png", image, durable=False)
                bar.update(1)


def _too_few(file: Path, frames: int, views: int) -> XrgsError:
    return XrgsError(f"scene.views={views}: {file} has {frames} frames; lower scene.views")


def sharpest(sharpness: list[float], parts: int) -> list[int]:
    """Divide a list into equal parts; return the index of the largest value of each part.

    The sizes of the parts differ by at most one. Of equal values the first is taken.
    """
    ends = [round(part * len(sharpness) / parts) for part in range(parts + 1)]
    return [max(range(a, b), key=lambda i: sharpness[i]) for a, b in pairwise(ends)]


def measure_sharpness(brightness: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of a brightness [H, W] in 0..255."""
    from scipy.ndimage import laplace

    return float(laplace(brightness.astype(np.float32)).var())


def _frames(file: Path) -> Generator[_Frame, None, None]:
    """Decode the frames of the first video stream.

    Data that can't be decoded end the video with a warning; before the first frame, with an error.
    """
    import av

    number = 0
    try:
        with _opened(file) as container:
            if not (streams := _streams(container)):
                raise images.ImageError(f"{file}: it has no video")
            video = streams[0]
            video.thread_type = "AUTO"
            # Read before frames are decoded: some decoders forget what the container says.
            codec, aspect = video.codec_context, video.sample_aspect_ratio or Fraction(1)
            encoding = colour.from_h273(codec.color_primaries, codec.color_trc)
            for frame in deinterlaced(container.decode(video)):
                width, height = _square(frame.width, frame.height, aspect)
                if width * height > images.MAX_PIXELS:
                    size = f"{width} x {height}"
                    raise images.ImageError(f"{file}: its frames have {size} pixels, too many")
                yield _Frame(frame, encoding, (width, height))
                number += 1
    except colour.ColourError as error:
        raise images.ImageError(f"{file}: {error}") from error
    except (av.FFmpegError, OSError) as error:
        if number == 0:
            raise images.ImageError(f"{file}: unreadable as a video ({error})") from error
        _log.warning("%s", for_line(f"{file}: ends after frame {number} ({error})"))


def _square(width: int, height: int, aspect: Fraction) -> tuple[int, int]:
    """Return the size with square pixels, never smaller; `aspect` is a pixel's width / height."""
    if aspect > 1:
        return round(width * aspect), height
    return width, round(height / aspect)


def _brightness(frame: VideoFrame) -> NDArray[np.uint8]:
    """Return the brightness [H, W] of a frame, at the size at which sharpness is measured."""
    scale = min(1.0, _SHARPNESS_SIDE / max(frame.width, frame.height))
    small = frame.reformat(
        max(1, round(frame.width * scale)), max(1, round(frame.height * scale)), format="gray"
    )
    return small.to_ndarray().astype(np.uint8)


def _shown(frame: _Frame) -> images.ImageArray:
    """Return a frame [H, W, 3] in 0..1: in sRGB, with square pixels, upright."""
    decoded = frame.decoded
    is_hd = decoded.colorspace == _UNKNOWN_MATRIX and decoded.height >= _HD_ROWS
    pixels = decoded.reformat(
        format="rgb24", src_colorspace="ITU709" if is_hd else None
    ).to_ndarray()
    image, _ = colour.convert(pixels, None, frame.encoding)
    return np.ascontiguousarray(_upright(images.resize(image, *frame.size), decoded))


def _upright(image: images.ImageArray, frame: VideoFrame) -> images.ImageArray:
    """Turn and mirror an image by the matrix of its frame, to the nearest quarter turn.

    The matrix begins with a, b, u, c, d in 32-bit integers: (x, y) is shown at (ax + cy, bx + dy),
    with y down. PyAV's `rotation` has no mirroring.
    """
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return image
    a, b, _, c, d = struct.unpack_from("=5i", matrix)
    if abs(b) > abs(a):
        image, a, d = image.swapaxes(0, 1), c, b
    return image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def deinterlaced(frames: Iterable[VideoFrame]) -> Iterator[VideoFrame]:
    """Yield every frame of a video; those of two fields are deinterlaced.

    RGB frames stay as they are; all others get new times.
    """
    for _, alike in groupby(frames, _layout):
        yield from _filtered(alike)


def _layout(frame: VideoFrame) -> tuple[int, int, str, int, int]:
    """Return the properties of a frame for which a filter graph is made."""
    colours = int(frame.colorspace), int(frame.color_range)
    return frame.width, frame.height, frame.format.name, *colours


def _graph(warm_up: Sequence[VideoFrame]) -> Graph:
    """Build the filter graph: a source of frames, the filters and a sink."""
    from av.filter import Graph

    width, height, pixels, matrix, levels = _layout(warm_up[0])
    graph = Graph()
    source = graph.add(
        "buffer",
        video_size=f"{width}x{height}",
        pix_fmt=pixels,
        time_base=str(_TIME_BASE),
        pixel_aspect="1/1",
        colorspace=str(matrix),
        range=str(levels),
    )
    is_marked = any(frame.interlaced_frame for frame in warm_up)
    detectors = [] if is_marked else [graph.add("idet", intl_thres=str(_LEAST_RATIO))]
    filters = (*detectors, graph.add("bwdif", mode="send_frame", deint="interlaced"))
    graph.link_nodes(source, *filters, graph.add("buffersink")).configure()
    return graph


def _filtered(frames: Iterator[VideoFrame]) -> Iterator[VideoFrame]:
    """Yield filtered frames; all have one layout."""
    import av

    warm_up = [*islice(frames, _WARM_UP)]
    if warm_up[0].format.is_rgb:
        yield from chain(warm_up, frames)
        return
    graph = _graph(warm_up)
    for time, frame in enumerate(chain(warm_up, warm_up, frames, [None]), -len(warm_up)):
        if frame is not None:
            frame.pts, frame.time_base = time, _TIME_BASE
        graph.vpush(frame)
        while True:
            try:
                made = graph.vpull()
            except (av.BlockingIOError, av.EOFError):
                break
            if made.pts is not None and made.pts >= 0:
                yield made
