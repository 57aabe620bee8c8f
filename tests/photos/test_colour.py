"""Colours against closed forms in float64, and against Pillow's ImageCms."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from PIL import Image, ImageCms

from tests.photos.made_files import ADOBE_RGB, DISPLAY_P3, SRGB, cmyk_profile, png, profile
from xrgs.photos import colour, images
from xrgs.photos.images import ImageError

Floats = NDArray[np.float64]
#: Linear sRGB in the profile connection space, as LittleCMS's own profile has it.
SRGB_XYZ = np.array(
    [
        getattr(ImageCms.ImageCmsProfile(io.BytesIO(SRGB)).profile, f"{name}_colorant")[0]
        for name in ("red", "green", "blue")
    ]
).T
GAMMA = 563 / 256  # what a profile of gamma 2.2 holds


def smooth(seed: int = 0, size: tuple[int, int] = (60, 40)) -> NDArray[np.uint8]:
    """A picture without edges, which JPEG keeps."""
    noise = np.random.default_rng(seed).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(noise).resize(size, Image.Resampling.BICUBIC))


def encoded(linear: Floats) -> Floats:
    """sRGB's curve."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decoded(values: Floats) -> Floats:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def expected(values: Floats, primaries: tuple[tuple[float, float, float], ...]) -> Floats:
    """RGB of a profile of these primaries and GAMMA as sRGB."""
    matrix = np.linalg.inv(SRGB_XYZ) @ np.array(primaries).T
    return encoded(values**GAMMA @ matrix.T)


@pytest.mark.parametrize(
    ("suffix", "primaries"),
    [
        *(("png", DISPLAY_P3), ("jpg", ADOBE_RGB), ("tif", DISPLAY_P3), ("webp", ADOBE_RGB)),
        ("heic", DISPLAY_P3),
    ],
)
def test_a_profile_is_applied(
    tmp_path: Path, suffix: str, primaries: tuple[tuple[float, float, float], ...]
) -> None:
    icc = profile("A camera's own", GAMMA, primaries)
    options: dict[str, dict[str, Any]] = {
        "jpg": {"quality": 100, "subsampling": 0},
        "webp": {"lossless": True},
        "heic": {"quality": -1, "chroma": 444, "matrix_coefficients": 0},
    }
    pillow_heif.register_heif_opener()
    file = tmp_path / f"a.{suffix}"
    Image.fromarray(smooth()).save(file, icc_profile=icc, **options.get(suffix, {}))
    stored = np.asarray(Image.open(file)) / 255
    picture = images.decode(file)
    assert picture.notes == ("converted from A camera's own to sRGB",)
    assert np.abs(picture.pixels - expected(stored, primaries)).max() < 1.5 / 255


@pytest.mark.parametrize("bits", [8, 16])
def test_grey_with_a_profile(tmp_path: Path, bits: int) -> None:
    ramp = np.linspace(0, 255 if bits == 8 else 65535, 256).round()
    grey = np.tile(ramp, (8, 1)).astype(np.uint8 if bits == 8 else np.uint16)
    icc = profile("Gamma 2.2", GAMMA)
    tifffile.imwrite(tmp_path / "a.tif", grey, photometric="minisblack", iccprofile=icc)
    picture = images.decode(tmp_path / "a.tif")
    truth = encoded((grey / grey.max()) ** GAMMA)[..., None]
    assert np.abs(picture.pixels - truth).max() < (1.1 if bits == 8 else 0.1) / 255
    assert picture.notes == ("converted from Gamma 2.2 to sRGB",)


@settings(max_examples=30)
@given(arrays(np.uint16, (3, 5, 3)), st.sampled_from([DISPLAY_P3, ADOBE_RGB]))
def test_16_bits_stay_16_through_a_profile(
    samples: NDArray[np.uint16], primaries: tuple[tuple[float, float, float], ...]
) -> None:
    converted, note = colour.convert(samples, profile("p", GAMMA, primaries), None)
    truth = expected(samples / 65535, primaries)
    assert np.abs(converted - truth).max() < 0.15 / 255
    assert note == "converted from p to sRGB"


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_srgb_and_no_profile_are_the_same_bits(tmp_path: Path, suffix: str) -> None:
    plain, tagged = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    Image.fromarray(smooth()).save(plain)
    Image.fromarray(smooth()).save(tagged, icc_profile=SRGB)
    stored = np.asarray(Image.open(plain)).astype(np.float32) / np.float32(255)
    for file in (plain, tagged):
        picture = images.decode(file)
        assert np.array_equal(picture.pixels, stored)
        assert picture.notes == ()


DAMAGED = "ICC profile ignored, since it is damaged or of another colour space"


@pytest.mark.parametrize(
    ("icc", "mode", "note"),
    [
        (b"no profile", "RGB", DAMAGED),
        (profile("p", GAMMA, DISPLAY_P3)[:200], "RGB", DAMAGED),
        (profile("p", GAMMA), "RGB", DAMAGED),
        (
            profile("p", GAMMA, DISPLAY_P3),
            "L",
            "ICC profile p ignored, since it is of RGB and the image is grey",
        ),
        (SRGB, "L", ""),
        (b"", "RGB", ""),
    ],
)
def test_a_profile_that_cant_be_used_is_ignored(
    tmp_path: Path, icc: bytes, mode: str, note: str
) -> None:
    image = Image.fromarray(smooth()).convert(mode)
    image.save(tmp_path / "a.jpg", icc_profile=icc)
    picture = images.decode(tmp_path / "a.jpg")
    plain = np.asarray(Image.open(tmp_path / "a.jpg").convert("RGB")).astype(np.float32)
    assert np.array_equal(picture.pixels, plain / np.float32(255))
    assert picture.notes == ((note,) if note else ())


@pytest.mark.parametrize("form", ["jpg", "tif", "tif of 16 bits"])
def test_cmyk_without_a_profile_is_said(tmp_path: Path, form: str) -> None:
    samples, file = np.dstack([smooth(), smooth(1)[..., 0]]), tmp_path / f"a.{form[:3]}"
    stored = Image.fromarray(samples, "CMYK")
    if form == "tif of 16 bits":
        tifffile.imwrite(file, samples.astype(np.uint16) * 257, photometric="separated")
    else:
        stored.save(file)
        stored = Image.open(file)
    picture = images.decode(file)
    assert np.abs(picture.pixels * 255 - np.asarray(stored.convert("RGB"))).max() < 0.6
    assert picture.notes == ("converted from CMYK without a profile",)


def inks() -> NDArray[np.float64]:
    """sRGB [2, 2, 2, 2, 3] of all solid inks: strong, but not those of a screen."""
    on = np.stack(np.meshgrid(*[[0, 1]] * 4, indexing="ij"), -1)
    rgb = 1 - 0.8 * on[..., :3]
    rgb[..., 0] -= 0.1 * on[..., 1]
    return np.asarray(np.clip(rgb, 0, 1) * (1 - 0.9 * on[..., 3:]))


@pytest.mark.parametrize("form", ["jpg", "tif", "tif of 16 bits"])
def test_cmyk_is_converted_by_its_profile(tmp_path: Path, form: str) -> None:
    """Of each solid ink, whose colour the profile has: full ink is dark, also in Adobe's JPEGs."""
    patches = np.round(inks().reshape(1, 16, 3) * 255).astype(np.uint8)
    transform = ImageCms.buildTransform(
        ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB"), "RGB", "LAB"
    )
    converted = ImageCms.applyTransform(Image.fromarray(patches), transform)
    stored = np.asarray(converted).astype(int)  # L, and a and b as signed bytes
    lab = np.dstack([stored[..., :1], (stored[..., 1:] + 128) % 256]).reshape(2, 2, 2, 2, 3)
    icc = cmyk_profile(lab)
    on = np.stack(np.meshgrid(*[[0, 255]] * 4, indexing="ij"), -1).reshape(1, 16, 4)
    cmyk = np.repeat(np.repeat(on, 16, 0), 16, 1).astype(np.uint8)
    file = tmp_path / f"a.{form[:3]}"
    if form == "tif of 16 bits":
        deep = cmyk.astype(np.uint16) * 257
        tifffile.imwrite(file, deep, photometric="separated", iccprofile=icc)
    else:
        options: dict[str, Any] = {"quality": 100, "subsampling": 0} if form == "jpg" else {}
        Image.fromarray(cmyk, "CMYK").save(file, icc_profile=icc, **options)
    picture = images.decode(file)
    assert picture.notes == ("converted from inks to sRGB",)
    seen = picture.pixels[8, 8::16]
    # Black point compensation changes dark inks, and Lab of 8 bits all by a little.
    assert np.abs(seen - inks().reshape(16, 3)).max() < 0.04


def test_lab_is_as_scikit_image_gives_it(tmp_path: Path) -> None:
    from skimage import color

    grid = np.stack(np.meshgrid(range(120, 180, 10), range(-20, 21, 5), range(-20, 21, 5)), -1)
    stored = grid.reshape(1, -1, 3)
    tifffile.imwrite(
        tmp_path / "a.tif", stored.astype(np.uint8), photometric="cielab", planarconfig="contig"
    )
    xyz = color.lab2xyz(stored * [100 / 255, 1, 1], illuminant="D50")
    picture = images.decode(tmp_path / "a.tif")
    assert picture.notes == ("converted from CIELAB to sRGB",)
    assert np.abs(picture.pixels - encoded(xyz @ np.linalg.inv(SRGB_XYZ).T)).max() < 1.5 / 255


GAMMA_1 = (b"gAMA", (100_000).to_bytes(4, "big"))
GAMMA_SRGB = (b"gAMA", (45_455).to_bytes(4, "big"))
P3_XY = (0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
SRGB_XY = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)


def chrm(xy: tuple[float, ...]) -> tuple[bytes, bytes]:
    return b"cHRM", b"".join(round(value * 100_000).to_bytes(4, "big") for value in xy)


#: The matrices to linear sRGB that Apple's and Adobe's documents lead to, at D65.
P3_MATRIX = np.array(
    [[1.2249401, -0.2249404, 0], [-0.0420569, 1.0420571, 0], [-0.0196376, -0.0786361, 1.0982735]]
)
ADOBE_MATRIX = np.array([[1.3983557, -0.3983557, 0], [0, 1, 0], [0, -0.0429290, 1.0429290]])


def p3(values: Floats) -> Floats:
    """Display P3 with sRGB's curve as sRGB."""
    return encoded(decoded(values) @ P3_MATRIX.T)


@pytest.mark.parametrize(
    ("bits", "chunks", "truth", "note"),
    [
        (8, [GAMMA_1], encoded, "converted from gamma 1 to sRGB"),
        (8, [(b"cICP", bytes([12, 13, 0, 1]))], p3, "converted from Display P3 to sRGB"),
        (16, [GAMMA_SRGB, chrm(P3_XY)], p3, "converted from the primaries of cHRM to sRGB"),
        (16, [(b"cICP", bytes([1, 8, 0, 1]))], encoded, "converted from linear sRGB to sRGB"),
    ],
)
def test_colours_that_a_png_names_are_converted(
    tmp_path: Path, bits: int, chunks: list[tuple[bytes, bytes]], truth: object, note: str
) -> None:
    most = 255 if bits == 8 else 65535
    samples = np.round(smooth() / 255 * most)
    (tmp_path / "a.png").write_bytes(png(samples, *chunks, bits=bits))
    picture = images.decode(tmp_path / "a.png")
    assert picture.notes == (note,)
    assert callable(truth)
    assert np.abs(picture.pixels - truth(samples / most)).max() < 0.1 / 255


@pytest.mark.parametrize(
    "chunks",
    [
        [GAMMA_SRGB, chrm(SRGB_XY)],
        [(b"sRGB", b"\0"), GAMMA_1, chrm(P3_XY)],
        [(b"cICP", bytes([1, 13, 0, 1])), GAMMA_1],
        [(b"gAMA", bytes(4))],
        [chrm((0.3,) * 8)],
        *([(b"cICP", bytes([1, transfer, 0, 1]))] for transfer in (1, 6, 14, 15, 2)),
    ],
)
def test_a_png_that_names_srgb_or_nothing_valid_is_read_as_it_is(
    tmp_path: Path, chunks: list[tuple[bytes, bytes]]
) -> None:
    (tmp_path / "a.png").write_bytes(png(smooth(), *chunks, bits=8))
    picture = images.decode(tmp_path / "a.png")
    assert np.array_equal(picture.pixels, smooth().astype(np.float32) / np.float32(255))
    assert picture.notes == ()


#: The chromaticities of red, green, blue and white by H.273's numbers (its table 2).
H273: dict[int, list[tuple[float, float]]] = {
    1: [(0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3127, 0.329)],
    4: [(0.67, 0.33), (0.21, 0.71), (0.14, 0.08), (0.31, 0.316)],
    5: [(0.64, 0.33), (0.29, 0.6), (0.15, 0.06), (0.3127, 0.329)],
    6: [(0.63, 0.34), (0.31, 0.595), (0.155, 0.07), (0.3127, 0.329)],
    7: [(0.63, 0.34), (0.31, 0.595), (0.155, 0.07), (0.3127, 0.329)],
    8: [(0.681, 0.319), (0.243, 0.692), (0.145, 0.049), (0.31, 0.316)],
    9: [(0.708, 0.292), (0.17, 0.797), (0.131, 0.046), (0.3127, 0.329)],
    10: [(1, 0), (0, 1), (0, 0), (1 / 3, 1 / 3)],
    11: [(0.68, 0.32), (0.265, 0.69), (0.15, 0.06), (0.314, 0.351)],
    12: [(0.68, 0.32), (0.265, 0.69), (0.15, 0.06), (0.3127, 0.329)],
    22: [(0.63, 0.34), (0.295, 0.605), (0.155, 0.077), (0.3127, 0.329)],
}
#: The Bradford matrix [lam1985], as in ICC's specification (annex E).
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def to_linear_srgb(primaries: int) -> Floats:
    """The matrix [3, 3] from linear RGB to linear sRGB: RGB of 1 is white in both."""

    def to_xyz(number: int) -> tuple[Floats, Floats]:
        *colours, white = ((x, y, 1 - x - y) for x, y in H273[number])
        xyz = np.array(white) / white[1]
        matrix = np.array(colours).T
        return matrix @ np.diag(np.linalg.inv(matrix) @ xyz), xyz

    (matrix, white), (srgb, target) = to_xyz(primaries), to_xyz(1)
    scales = np.diag((BRADFORD @ target) / (BRADFORD @ white))
    adapted: Floats = np.linalg.inv(srgb) @ np.linalg.inv(BRADFORD) @ scales @ BRADFORD @ matrix
    return adapted


#: The light of a value by H.273's numbers of curves (its table 3).
CURVES: dict[int, Callable[[Floats], Floats]] = {
    4: lambda v: v**2.2,
    5: lambda v: v**2.8,
    7: lambda v: np.where(v < 0.0912, v / 4, ((v + 0.1115) / 1.1115) ** (1 / 0.45)),
    8: lambda v: v,
    13: decoded,
    17: lambda v: np.minimum(52.37 / 48 * v**2.6, 1),
}


@pytest.mark.parametrize(
    ("primaries", "transfer", "bits"),
    [*((number, 8, 16) for number in H273), *((12, number, 8) for number in CURVES)],
)
def test_the_numbers_of_cicp_are_converted(
    tmp_path: Path, primaries: int, transfer: int, bits: int
) -> None:
    most = 255 if bits == 8 else 65535
    samples = np.round(smooth() / 255 * most)
    chunk = b"cICP", bytes([primaries, transfer, 0, 1])
    (tmp_path / "a.png").write_bytes(png(samples, chunk, bits=bits))
    light = CURVES[transfer](samples / most) @ to_linear_srgb(primaries).T
    truth = encoded(np.clip(light, 0, 1))
    assert np.abs(images.decode(tmp_path / "a.png").pixels - truth).max() < 0.1 / 255


@pytest.mark.parametrize(
    ("bits", "black", "white", "channels"),
    [(8, 16, 235, 1), (8, 16, 235, 4), (16, 16 * 256, 235 * 256, 3)],
)
def test_values_of_narrow_range_are_stretched(
    tmp_path: Path, bits: int, black: int, white: int, channels: int
) -> None:
    """BT.709 and BT.2020: black is at 16 and white at 235 of 8 bits, times 256 of 16 bits."""
    truth = np.linspace(0, 1, 12).reshape(3, 4, 1)
    values = np.round(black + truth * (white - black))
    samples = np.repeat(values, channels, axis=2)
    if channels == 4:
        samples[..., 3] = 255 if bits == 8 else 65535
    samples[0, 0, 0], samples[-1, -1, 0] = 0, 255 if bits == 8 else 65535  # foot- and headroom
    (tmp_path / "a.png").write_bytes(png(samples, (b"cICP", bytes([1, 13, 0, 0])), bits=bits))
    picture = images.decode(tmp_path / "a.png")
    assert picture.alpha is None
    assert picture.notes == ("converted from narrow-range sRGB to sRGB",)
    found, step = picture.pixels.reshape(-1, 3), 0.5 / (white - black) + 1e-6
    assert np.abs(found[1:-1] - truth.reshape(-1, 1)[1:-1]).max() <= step
    assert found[0, 0] == 0
    assert found[-1, 0] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        ((9, 16, 0, 1), r"its brightness is HDR \(PQ\); save it as SDR"),
        ((9, 18, 0, 1), r"its brightness is HDR \(HLG\); save it as SDR"),
        ((1, 9, 0, 1), "its brightness is logarithmic brightness"),
        ((1, 19, 0, 1), "its curve is number 19 of H.273"),
        ((13, 13, 0, 1), "its primaries are number 13 of H.273"),
        ((1, 13, 1, 1), "its cICP names a matrix"),
    ],
)
def test_numbers_that_are_not_known_are_refused(
    tmp_path: Path, numbers: tuple[int, ...], why: str
) -> None:
    (tmp_path / "a.png").write_bytes(png(smooth(), (b"cICP", bytes(numbers)), bits=8))
    with pytest.raises(ImageError, match=rf"a\.png: {why}"):
        images.decode(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("suffix", "primaries", "transfer"),
    [("avif", 12, 13), ("avif", 1, 5), ("avif", 9, 16), ("heic", 12, 13), ("heic", 9, 16)],
)
def test_avif_and_heic_name_their_colours_by_number(
    tmp_path: Path, suffix: str, primaries: int, transfer: int
) -> None:
    file, values = tmp_path / f"a.{suffix}", smooth() / 255
    if suffix == "heic":
        pillow_heif.register_heif_opener()
        options: dict[str, Any] = {"quality": -1, "chroma": 444, "matrix_coefficients": 0}
        options |= {"color_primaries": primaries, "transfer_characteristics": transfer}
        Image.fromarray(smooth()).save(file, **options)
    else:
        Image.fromarray(smooth()).save(file, quality=100, subsampling="4:4:4")
        values = images.decode(file).pixels.astype(np.float64)
        content = bytearray(file.read_bytes())
        at = content.index(b"colrnclx") + 8
        content[at : at + 4] = struct.pack(">HH", primaries, transfer)
        file.write_bytes(content)
    if transfer == 16:
        with pytest.raises(ImageError, match=rf"a\.{suffix}: its brightness is HDR"):
            images.decode(file)
        return
    light = CURVES[transfer](values) @ to_linear_srgb(primaries).T
    picture = images.decode(file)
    assert np.abs(picture.pixels - encoded(np.clip(light, 0, 1))).max() < 0.1 / 255
    assert len(picture.notes) == 1


def test_the_profile_of_a_jpeg_2000_is_applied(tmp_path: Path) -> None:
    """Pillow does not read it; the box of colours has method 2 and the profile."""
    Image.fromarray(smooth()).save(tmp_path / "a.jp2", irreversible=False)
    plain = images.decode(tmp_path / "a.jp2").pixels
    assert np.array_equal(plain * 255, np.float32(smooth()))
    content = (tmp_path / "a.jp2").read_bytes()
    at = content.index(b"colr") - 4
    icc = profile("P3", 2.2, DISPLAY_P3)
    box = struct.pack(">I", 11 + len(icc)) + b"colr\2\0\0" + icc
    header = content.index(b"jp2h") - 4
    length = int.from_bytes(content[header : header + 4], "big") - 15 + len(box)
    made = content[:header] + struct.pack(">I", length) + content[header + 4 : at] + box
    (tmp_path / "a.jp2").write_bytes(made + content[at + 15 :])
    Image.fromarray(smooth()).save(tmp_path / "b.png", icc_profile=icc)
    found = images.decode(tmp_path / "a.jp2")
    assert np.array_equal(found.pixels, images.decode(tmp_path / "b.png").pixels)
    assert found.notes == ("converted from P3 to sRGB",)


@pytest.mark.parametrize(("index", "space"), [("R03", 0xFFFF), ("R98", 1), (None, 2)])
def test_a_camera_set_to_adobe_rgb_says_so_in_exif(
    tmp_path: Path, index: str | None, space: int
) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = space
    if index is not None:
        exif.get_ifd(0x8769)[0xA005] = {1: index}
    Image.fromarray(smooth()).save(tmp_path / "a.jpg", quality=100, subsampling=0, exif=exif)
    stored = np.asarray(Image.open(tmp_path / "a.jpg")) / 255
    picture = images.decode(tmp_path / "a.jpg")
    if index != "R03" and space != 2:
        assert np.array_equal(picture.pixels, stored.astype(np.float32))
        return
    truth = encoded(stored ** (563 / 256) @ ADOBE_MATRIX.T)
    assert np.abs(picture.pixels - truth).max() < 0.1 / 255
    assert picture.notes == ("converted from Adobe RGB to sRGB",)
