"""Photographs of more than 8 bits keep all of them; those without a known white are refused."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from PIL import Image

from tests.photos.made_files import SHORT, png, with_entry
from xrgs.photos import exif, images
from xrgs.photos.images import ImageError

#: An image whose first value is white, so that its depth is plain.
SAMPLES = st.integers(1, 4).flatmap(
    lambda channels: arrays(np.uint16, (5, 9, channels), elements=st.integers(0, 65535))
)


def truth(samples: NDArray[Any], white: int = 65535) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """RGB and alpha in 0..1 in float64 of grey, RGB and their like with alpha."""
    count = samples.shape[2]
    values = samples / white
    colours, alpha = values[..., : count - (count in (2, 4))], values[..., -1]
    return np.broadcast_to(colours, (*colours.shape[:2], 3)), alpha if count in (2, 4) else None


def check(file: Path, samples: NDArray[Any], white: int = 65535, error: float = 1e-6) -> None:
    colours, alpha = truth(samples, white)
    picture = images.decode(file)
    assert picture.pixels.dtype == np.float32
    assert images.size(file) == (samples.shape[1], samples.shape[0])
    assert np.abs(picture.pixels - colours).max() < error
    assert (picture.alpha is None) == (alpha is None or alpha.min() == 1)
    if picture.alpha is not None and alpha is not None:
        assert np.abs(picture.alpha - alpha).max() < 1e-6


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(samples=SAMPLES, interlaced=st.booleans())
def test_a_png_of_16_bits(tmp_path: Path, samples: NDArray[np.uint16], interlaced: bool) -> None:
    samples[0, 0] = 65535
    (tmp_path / "a.png").write_bytes(png(samples, interlaced=interlaced))
    check(tmp_path / "a.png", samples)


@pytest.mark.parametrize("channels", [1, 3])
def test_the_transparent_colour_of_a_png_of_16_bits(tmp_path: Path, channels: int) -> None:
    samples = np.random.default_rng(0).integers(20_000, 65536, (5, 9, channels))
    samples[2, 3] = range(1, channels + 1)
    key = struct.pack(f">{channels}H", *range(1, channels + 1))
    (tmp_path / "a.png").write_bytes(png(samples, (b"tRNS", key)))
    picture = images.decode(tmp_path / "a.png")
    assert picture.alpha is not None
    assert np.argwhere(picture.alpha < 1).tolist() == [[2, 3]]
    assert picture.alpha[2, 3] == 0


OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "big endian": {"byteorder": ">"},
    "LZW": {"compression": "lzw", "predictor": True},
    "LZW, predictor, big endian": {"compression": "lzw", "predictor": True, "byteorder": ">"},
    "deflate": {"compression": "zlib", "rowsperstrip": 7},
    "tiles": {"compression": "zlib", "predictor": True, "tile": (16, 16)},
    "planes": {"planarconfig": "separate", "compression": "lzw"},
    "BigTIFF": {"bigtiff": True},
}


@pytest.mark.parametrize(
    ("kind", "channels"),
    [*((kind, 3) for kind in OPTIONS), ("plain", 1), ("tiles", 2), ("planes", 4), ("LZW", 4)],
)
def test_a_tiff_of_16_bits(tmp_path: Path, kind: str, channels: int) -> None:
    samples = np.random.default_rng(0).integers(0, 65536, (40, 60, channels)).astype(np.uint16)
    options = {"planarconfig": "contig"} | OPTIONS[kind]
    stored = samples.transpose(2, 0, 1).copy() if kind == "planes" else samples
    if channels == 1:
        stored, options = samples[..., 0], {}
    tifffile.imwrite(
        tmp_path / "a.tif",
        stored,
        photometric="rgb" if channels > 2 else "minisblack",
        extrasamples=["unassalpha"] if channels in (2, 4) else None,
        **options,
    )
    check(tmp_path / "a.tif", samples)


@pytest.mark.parametrize("bits", [10, 14])
def test_a_tiff_that_packs_bits_is_scaled_by_its_depth(tmp_path: Path, bits: int) -> None:
    samples = np.random.default_rng(0).integers(0, 1 << bits, (40, 60, 3)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", samples, photometric="rgb", bitspersample=bits)
    check(tmp_path / "a.tif", samples, (1 << bits) - 1, error=1e-5)


def test_colours_of_associated_alpha_are_divided_by_it(tmp_path: Path) -> None:
    samples = np.random.default_rng(0).integers(0, 65536, (40, 60, 4)).astype(np.uint16)
    samples[..., 3] = np.maximum(samples[..., 3], 1000)
    multiplied = samples.copy()
    multiplied[..., :3] = np.round(samples[..., :3] * (samples[..., 3:] / 65535))
    tifffile.imwrite(tmp_path / "a.tif", multiplied, photometric="rgb", extrasamples=["assocalpha"])
    check(tmp_path / "a.tif", samples, error=0.6 / 1000)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_channels_that_are_not_called_alpha_are_ignored_with_a_word(
    tmp_path: Path, kind: type[np.unsignedinteger[Any]]
) -> None:
    white = np.iinfo(kind).max
    samples = np.random.default_rng(0).integers(0, white, (40, 60, 5)).astype(kind)
    tifffile.imwrite(
        tmp_path / "a.tif", samples, photometric="rgb", extrasamples=["unspecified"] * 2
    )
    check(tmp_path / "a.tif", samples[..., :3], white)
    said = ("a channel ignored, which the file does not call alpha",)
    assert images.decode(tmp_path / "a.tif").notes == said


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_fourth_channel_without_a_word_is_alpha(
    tmp_path: Path, kind: type[np.unsignedinteger[Any]]
) -> None:
    white = np.iinfo(kind).max
    samples = np.random.default_rng(0).integers(0, white, (40, 60, 4)).astype(kind)
    tifffile.imwrite(tmp_path / "a.tif", samples, photometric="rgb", extrasamples=["unassalpha"])
    content = (tmp_path / "a.tif").read_bytes()
    entry = struct.pack("<HHI", 338, 3, 1)
    assert content.count(entry) == 1
    (tmp_path / "a.tif").write_bytes(content.replace(entry, struct.pack("<HHI", 337, 3, 1)))
    check(tmp_path / "a.tif", samples, white)


@pytest.mark.parametrize("orientation", [0, 1, 3, 6, 7])
def test_a_tiff_of_16_bits_is_turned_once(tmp_path: Path, orientation: int) -> None:
    """As Pillow turns the same picture of 8 bits."""
    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    tag = [(0x0112, SHORT, 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", picture, photometric="rgb", extratags=tag)
    deep = picture.astype(np.uint16) * 257
    tifffile.imwrite(tmp_path / "b.tif", deep, photometric="rgb", extratags=tag)
    upright = np.asarray(Image.open(tmp_path / "a.tif").convert("RGB")) / 255
    for name in ("a.tif", "b.tif"):
        read = images.decode(tmp_path / name)
        assert np.abs(read.pixels - upright).max() < 1e-6
        assert images.size(tmp_path / name) == upright.shape[1::-1]
        assert read.orientation == (orientation if orientation in range(1, 9) else 1)


@pytest.mark.parametrize(("bits", "channels"), [(10, 1), (10, 3), (12, 4)])
def test_heic_of_10_and_12_bits(tmp_path: Path, bits: int, channels: int) -> None:
    white = (1 << bits) - 1
    samples = np.random.default_rng(0).integers(0, white + 1, (40, 60, channels))
    mode = {1: "L;16", 3: "RGB;16", 4: "RGBA;16"}[channels]
    stored = (samples << (16 - bits)).astype(np.uint16)
    heif = pillow_heif.from_bytes(mode, (60, 40), stored.tobytes())
    old = pillow_heif.options.SAVE_HDR_TO_12_BIT
    pillow_heif.options.SAVE_HDR_TO_12_BIT = bits == 12
    lossless = {"quality": -1} | (
        {} if channels == 1 else {"chroma": 444, "matrix_coefficients": 0}
    )
    heif.save(tmp_path / "a.heic", **lossless)
    pillow_heif.options.SAVE_HDR_TO_12_BIT = old
    check(tmp_path / "a.heic", samples, white, error=1e-5)


@pytest.mark.parametrize(("suffix", "bits"), [("png", 1), ("png", 14), ("tif", 12)])
def test_the_low_bits_alone_are_refused(tmp_path: Path, suffix: str, bits: int) -> None:
    samples = np.full((9, 9, 3), (1 << bits) - 1, np.uint16)
    file = tmp_path / f"a.{suffix}"
    if suffix == "png":
        file.write_bytes(png(samples))
    else:
        tifffile.imwrite(file, samples, photometric="rgb")
    with pytest.raises(ImageError, match=rf"a\.{suffix}: .* so that it has {bits} bits in 16"):
        images.decode(file)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_the_low_bits_are_scaled_where_the_file_counts_them(tmp_path: Path, suffix: str) -> None:
    samples = np.random.default_rng(0).integers(0, 4096, (9, 9, 3)).astype(np.uint16)
    file = tmp_path / f"a.{suffix}"
    if suffix == "png":
        file.write_bytes(png(samples, (b"sBIT", bytes([12, 12, 12]))))
    else:
        tifffile.imwrite(
            file, samples, photometric="rgb", extratags=[(281, SHORT, 3, (4095,) * 3, True)]
        )
    check(file, samples, 4095, error=1e-5)
    assert images.decode(file).notes == ("scaled from 12 bits in 16",)


@pytest.mark.parametrize(
    ("samples", "why"),
    [
        (np.zeros((9, 9, 3), np.float32), "float values of 32 bits have no white"),
        (np.zeros((9, 9, 3), np.uint32), "unsigned values of 32 bits have no white"),
        (np.zeros((9, 9), np.int8), "signed values of 8 bits have no white"),
    ],
)
def test_values_without_a_white_are_refused(
    tmp_path: Path, samples: NDArray[Any], why: str
) -> None:
    photometric = "rgb" if samples.ndim == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tif", samples, photometric=photometric)
    with pytest.raises(ImageError, match=rf"a\.tif: {why}; save it with 8 or 16 bits"):
        images.decode(tmp_path / "a.tif")


def test_one_channel_of_16_bits_is_what_a_depth_map_has(tmp_path: Path) -> None:
    for channels in (1, 2, 3):
        (tmp_path / "a.png").write_bytes(png(np.full((9, 9, channels), 40_000, np.uint16)))
        assert images.header(tmp_path / "a.png").is_deep_grey == (channels == 1)
    tifffile.imwrite(tmp_path / "a.tif", np.full((9, 9), 40_000, np.uint16))
    assert images.header(tmp_path / "a.tif").is_deep_grey


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_a_truncated_tiff_of_16_bits_is_refused(tmp_path: Path, compression: str | None) -> None:
    samples = np.random.default_rng(0).integers(0, 65536, (40, 60, 3)).astype(np.uint16)
    tifffile.imwrite(
        tmp_path / "a.tif", samples, photometric="rgb", compression=compression, rowsperstrip=4
    )
    content = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(content[:-500])
    with pytest.raises(ImageError, match=r"a\.tif: unreadable or truncated image"):
        images.decode(tmp_path / "a.tif")


def test_a_tiff_without_some_of_its_strips_is_refused(tmp_path: Path) -> None:
    """Decoders take the missing ones for black."""
    samples = np.random.default_rng(0).integers(0, 65536, (40, 60, 3)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", samples, photometric="rgb", rowsperstrip=40)
    content = (tmp_path / "a.tif").read_bytes()
    head = struct.pack("<HHI", 279, 4, 1)
    place = content.index(head) + len(head)
    (tmp_path / "a.tif").write_bytes(content[:place] + bytes(4) + content[place + 4 :])
    with pytest.raises(ImageError, match=r"a\.tif: unreadable or truncated image"):
        images.decode(tmp_path / "a.tif")


def test_white_is_zero(tmp_path: Path) -> None:
    samples = np.random.default_rng(0).integers(0, 65536, (40, 60, 1)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", 65535 - samples[..., 0], photometric="miniswhite")
    check(tmp_path / "a.tif", samples)


def test_the_camera_of_a_tiff_of_16_bits_is_read(tmp_path: Path) -> None:
    samples = np.full((9, 9, 3), 40_000, np.uint16)
    tifffile.imwrite(
        tmp_path / "a.tif",
        samples,
        photometric="rgb",
        extratags=[(0x010F, 2, 0, "Maker", True), (0x0110, 2, 0, "X 100", True)],
    )
    assert exif.read(tmp_path / "a.tif").camera == "Maker/X 100"
    with_tag = with_entry((tmp_path / "a.tif").read_bytes(), SHORT, 1, b"\6\0")
    (tmp_path / "a.tif").write_bytes(with_tag)
    assert images.header(tmp_path / "a.tif").orientation == 6
