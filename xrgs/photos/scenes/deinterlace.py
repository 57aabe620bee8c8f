"""Deinterlaces videos, whose frames are woven of two fields that were taken one after the other.

In such a frame moving things have combed edges, which would count as sharpness. Frames that the
video marks as interlaced are deinterlaced by FFmpeg's `bwdif`, as in a player. If it marks none,
`idet` compares the lines of each frame with its neighbours, and marks those of two fields.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import chain, groupby, islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from av.filter.graph import Graph
    from av.video.frame import VideoFrame

#: `idet` leaves its first frames undecided, so this many frames are fed to it twice.
_WARM_UP = 12
#: `idet` marks a frame if one field differs this many times more from the frame before it than the
#: other field does. FFmpeg's own 1.04 marks frames of a camera that moves slowly; our choice.
_LEAST_RATIO = 1.2
_TIME_BASE = Fraction(1, 25)


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
