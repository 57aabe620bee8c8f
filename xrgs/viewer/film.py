"""Renders models along a path of cameras, side by side, into an MP4 film or PNG frames.

Evaluation has the same renderer and settings: a frame at a test camera, if it has the intrinsics of
the first test view, equals the scored render.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from xrgs.errors import XrgsError
from xrgs.photos.images import to_8_bit, write_png
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import list_names
from xrgs.safeio.sanitize import counted
from xrgs.splat.cameras import Camera
from xrgs.splat.rendering import rasterize
from xrgs.viewer.models import Model, reference
from xrgs.viewer.paths import PATHS, default_path

Frame = NDArray[np.uint8]  # [H, W, 3]

_MP4 = ".mp4"
#: Smallest and largest side of a panel, px, and the most frames of a film.
_SIDES, _MAX_FRAMES = (16, 8192), 100_000
#: The colours of a film by ITU-T H.273: primaries and matrix of BT.709, curve of sRGB, limited
#: range. Players would take BT.601's matrix for small films and BT.709's for large ones.
_PRIMARIES, _CURVE, _MATRIX, _LIMITED = 1, 13, 1, 1
#: x264's constant rate factor; 18 counts as visually lossless.
_CRF = "18"
#: The height of a label, as a share of the panel's, and its least height, px.
_LABEL_SHARE, _MIN_LABEL = 0.04, 12


def make_film(
    models: Sequence[Model],
    out: Path,
    *,
    path: str | None = None,
    views: int = 120,
    size: tuple[int, int] | None = None,
    fps: int = 30,
) -> str:
    """Render models of one world side by side along a path, into an .mp4 file or a folder of PNGs.

    The arguments are those of `xrgs-render`, whose help explains them. The path is fitted to the
    cameras of the first model that has any. A line for the terminal is returned.

    Raises:
        XrgsError: An argument is out of its range, no model has cameras, PyAV is missing, or `out`
            can't be written; the message names the argument.
    """
    _check(views, fps, size)
    is_film = _is_film(out)
    world = reference(models)
    if world is None or world.poses is None:
        raise XrgsError("the path is fitted to the cameras of a cell: give a cell beside the .ply")
    first_test = next(view for view in world.views if view.kind == "test")
    camera = _panel_camera(first_test.camera, size)
    path = path or default_path(world.poses)
    cameras = [
        Camera(torch.from_numpy(viewmat).float(), camera.K, camera.width, camera.height)
        for viewmat in PATHS[path](world.poses, views)
    ]
    frames = _frames(models, cameras)
    try:
        (_write_film if is_film else _write_pngs)(frames, out, fps)
    except OSError as error:
        raise XrgsError(f"out={out}: can't be written ({error.strerror or error})") from error
    shown = f"{len(models) * camera.width} x {camera.height} px"
    length = f", {views / fps:.1f} s" if is_film else ""
    return f"{out}: {counted(views, 'frame')} of {shown}{length}, path {path}"


def _check(views: int, fps: int, size: tuple[int, int] | None) -> None:
    if not 1 <= views <= _MAX_FRAMES:
        raise XrgsError(f"views={views}: must be from 1 to {_MAX_FRAMES}")
    if not 1 <= fps <= 240:
        raise XrgsError(f"fps={fps}: must be from 1 to 240")
    low, high = _SIDES
    if size is not None and not all(low <= side <= high and side % 2 == 0 for side in size):
        raise XrgsError(f"size={size[0]}x{size[1]}: must be even numbers from {low} to {high}")


def _is_film(out: Path) -> bool:
    """Return whether `out` is a film and not a folder; check that PyAV is there for a film."""
    if out.suffix.lower() != _MP4:
        if out.suffix:
            raise XrgsError(f"out={out}: must end with {_MP4}, or be a folder, without a suffix")
        return False
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise XrgsError(
            f"out={out}: a film needs PyAV: pip install 'xrgs[video]';"
            " --out FOLDER writes PNG frames"
        ) from error
    return True


def _panel_camera(view: Camera, size: tuple[int, int] | None) -> Camera:
    """Return the camera of a panel, which has the view's horizontal field of view."""
    width, height = size or (view.width - view.width % 2, view.height - view.height % 2)
    scale = width / view.width if size else 1.0
    K = view.K.clone()
    K[:2] *= scale
    if size:  # rows are added or cut equally at the top and the bottom
        K[1, 2] += (height - scale * view.height) / 2
    return Camera(view.viewmat, K, width, height)


def _frames(models: Sequence[Model], cameras: Sequence[Camera]) -> Iterator[Frame]:
    """Yield a frame for each camera: the renders of all models from left to right."""
    for camera in progress(cameras, "rendering", "frame"):
        panels = [_panel(model, camera) for model in models]
        if len(models) > 1:
            panels = [
                _labelled(panel, model.name) for panel, model in zip(panels, models, strict=True)
            ]
        yield np.concatenate(panels, axis=1)


@torch.no_grad()
def _panel(model: Model, camera: Camera) -> Frame:
    image = rasterize(model.gaussians, camera, settings=model.settings).image
    return to_8_bit(image.numpy())


def _labelled(panel: Frame, name: str) -> Frame:
    """Write a name into the upper left corner of a panel, white on a dark box."""
    image = Image.fromarray(panel)
    draw = ImageDraw.Draw(image)
    height = max(_MIN_LABEL, round(_LABEL_SHARE * image.height))
    font, margin = ImageFont.load_default(height), height // 2
    box = draw.textbbox((margin, margin), name, font)
    pad = height // 4
    draw.rectangle((box[0] - pad, box[1] - pad, box[2] + pad, box[3] + pad), fill="#202020")
    draw.text((margin, margin), name, "white", font)
    return np.asarray(image)


def _write_film(frames: Iterable[Frame], out: Path, fps: int) -> None:
    """Encode frames as H.264 in an MP4 file, which appears only when complete."""
    import av

    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writer(out) as stream, av.open(stream, "w", format="mp4") as container:
        video: Any = container.add_stream("libx264", rate=fps, options={"crf": _CRF})
        video.pix_fmt = "yuv420p"  # browsers and players need it
        coder = video.codec_context
        coder.color_primaries, coder.color_trc = _PRIMARIES, _CURVE
        coder.colorspace, coder.color_range = _MATRIX, _LIMITED
        for number, frame in enumerate(frames):
            if number == 0:
                video.height, video.width = frame.shape[:2]
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24").reformat(
                format=video.pix_fmt, dst_colorspace=_MATRIX, dst_color_range=_LIMITED
            )
            container.mux(video.encode(picture))
        container.mux(video.encode())


def _write_pngs(frames: Iterable[Frame], out: Path, _: int) -> None:
    """Write `0000.png`, `0001.png` and so on into a new or empty folder."""
    folder = out
    folder.mkdir(parents=True, exist_ok=True)
    if list_names(folder):
        raise XrgsError(f"out={out}: the folder is not empty; name a new one")
    for number, frame in enumerate(frames):
        with atomic_writer(folder / f"{number:04}.png", durable=False) as stream:
            write_png(stream, Image.fromarray(frame))
