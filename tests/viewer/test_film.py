"""Films: their frames against the rasterizer, the file against PyAV's reader, and bad arguments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from xrgs.errors import XrgsError
from xrgs.splat.cameras import Camera
from xrgs.splat.rendering import rasterize
from xrgs.splat.settings import RasterSettings
from xrgs.viewer import film
from xrgs.viewer.film import make_film
from xrgs.viewer.models import Model

MakeModel = Callable[..., Model]


def pictures(folder: Path) -> list[NDArray[np.uint8]]:
    return [np.asarray(Image.open(file)) for file in sorted(folder.iterdir())]


def render(model: Model, camera: Camera) -> NDArray[np.uint8]:
    with torch.no_grad():
        image = rasterize(model.gaussians, camera, settings=model.settings).image
    return np.round(image.double().numpy().clip(0, 1) * 255).astype(np.uint8)


def test_frames_at_test_views_are_their_renders(model: MakeModel, tmp_path: Path) -> None:
    shown = model(settings=RasterSettings(antialiased=True, background=(0.2, 0.1, 0.0)))
    line = make_film([shown], tmp_path / "frames", path="test", views=2, size=(48, 36))
    assert line == f"{tmp_path / 'frames'}: 2 frames of 48 x 36 px, path test"
    for frame, view in zip(pictures(tmp_path / "frames"), shown.views[2:], strict=True):
        scale = 48 / 49
        K = view.camera.K * torch.tensor([[scale], [scale], [1.0]])
        K[1, 2] += (36 - scale * 36) / 2
        expected = render(shown, Camera(view.camera.viewmat, K, 48, 36))
        assert np.abs(frame.astype(int) - expected).max() <= 1  # of the viewmat's last digit
        assert expected.std() > 10
    make_film([shown], tmp_path / "default", path="test", views=2)  # it leaves out an odd column
    frame, whole = pictures(tmp_path / "default")[0], render(shown, shown.views[2].camera)
    assert frame.shape == (36, 48, 3)
    assert np.abs(frame.astype(int) - whole[:, :48]).max() <= 1


def test_two_models_are_side_by_side_with_their_names(model: MakeModel, tmp_path: Path) -> None:
    first = model("baseline")
    second = replace(first, name="antialiased", gaussians=model(seed=5).gaussians)
    make_film([first, second], tmp_path / "both", views=2, size=(160, 120))
    for number, one in enumerate((first, second)):
        make_film([one], tmp_path / str(number), views=2, size=(160, 120))
        alone = pictures(tmp_path / str(number))[1]
        half = pictures(tmp_path / "both")[1][:, 160 * number : 160 * (number + 1)]
        assert (half[40:] == alone[40:]).all()
        assert (half[:40] != alone[:40]).any(), "the name"
        assert (half[:40] == 255).all(axis=-1).any(), "in white"


def test_frames_are_the_same_again_and_a_film_of_them_can_be_played(
    model: MakeModel, tmp_path: Path
) -> None:
    """The bytes of two films of the same frames may differ: x264 reads memory it never wrote."""
    for name in ("frames", "again"):
        make_film([model()], tmp_path / name, views=5, size=(64, 48))
    expected = pictures(tmp_path / "frames")
    np.testing.assert_array_equal(pictures(tmp_path / "again"), expected)
    line = make_film([model()], tmp_path / "a.mp4", views=5, size=(64, 48), fps=10)
    assert line.endswith("5 frames of 64 x 48 px, 0.5 s, path orbit")
    with av.open(str(tmp_path / "a.mp4")) as film:
        assert film.streams.video[0].average_rate == 10
        decoded = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(decoded) == len(expected) == 5
    for frame, picture in zip(decoded, expected, strict=True):
        assert np.abs(frame.astype(float) - picture).mean() < 6, "colours are halved in size"


def test_a_film_that_fails_leaves_the_old_one(
    model: MakeModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "film.mp4").write_bytes(b"old")

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("xrgs.viewer.film.rasterize", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_film([model()], tmp_path / "film.mp4", views=2)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("film.mp4", b"old")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"views": 0}, "views=0: must be from 1 to 100000"),
        ({"fps": 0}, "fps=0: must be from 1 to 240"),
        ({"size": (33, 32)}, "size=33x32: must be even numbers from 16 to 8192"),
        ({"out": "film.avi"}, "film.avi: must end with .mp4, or be a folder"),
        ({"out": "full"}, "full: the folder is not empty; name a new one"),
        ({"out": "full/file"}, "full/file: can't be written"),
    ],
    ids=str,
)
def test_wrong_arguments_are_named(
    model: MakeModel, tmp_path: Path, arguments: dict[str, Any], message: str
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    out = tmp_path / arguments.pop("out", "frames")
    with pytest.raises(XrgsError) as caught:
        make_film([model()], out, **arguments)
    assert message in str(caught.value)


def test_a_ply_alone_has_no_path(model: MakeModel, tmp_path: Path) -> None:
    ply = Model("a.ply", model().gaussians, RasterSettings())
    with pytest.raises(XrgsError, match=r"give a cell beside the \.ply"):
        make_film([ply], tmp_path / "frames")
    assert "20 frames" in make_film([ply, model()], tmp_path / "frames", views=20, size=(32, 32))


def test_without_pyav_the_extra_is_named(
    model: MakeModel, tmp_path: Path, without: Callable[[str], None]
) -> None:
    without("av")
    with pytest.raises(XrgsError, match=r"pip install 'xrgs\[video\]'; --out FOLDER writes PNG"):
        make_film([model()], tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [(96, 64), (96, 720), (1920, 64)], ids=str)
def test_the_colours_of_a_film_are_those_of_its_frames_at_every_size(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    """They are decoded by the matrix of BT.709 in float64, which the film must name."""
    colours = np.array([[204, 76, 51], [230, 30, 30], [30, 220, 40], [30, 60, 220], [9, 20, 40]])
    frame = np.repeat(colours, 16, axis=0)[None].repeat(size[1], axis=0).astype(np.uint8)
    frame = np.pad(frame, ((0, 0), (0, size[0] - 80), (0, 0)))
    film._write_film(iter([frame] * 3), tmp_path / "a.mp4", 10)
    with av.open(str(tmp_path / "a.mp4")) as container:
        (stream,) = container.streams.video
        coder = stream.codec_context
        named = (coder.color_primaries, coder.color_trc, coder.colorspace, coder.color_range)
        assert named == (1, 13, 1, 1)
        planes = next(container.decode(stream)).to_ndarray().astype(float)
    width, height = size
    row, middles = height // 2, np.arange(8, 80, 16)
    chroma = planes[height:].reshape(2, height // 2, width // 2)
    luma = (planes[row, middles] - 16) / 219
    blue, red = (chroma[:, row // 2, middles // 2] - 128) / 224
    r, b = luma + 1.5748 * red, luma + 1.8556 * blue
    decoded = np.stack([r, (luma - 0.2126 * r - 0.0722 * b) / 0.7152, b], axis=1) * 255
    assert np.abs(decoded - colours).max() < 4
