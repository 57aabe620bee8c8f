"""Converts photographs to sRGB: by their ICC profile, or by the primaries and curve they name.

An ICC profile is applied by LittleCMS, relative colorimetric with black point compensation, as
photo editors do. 8-bit pixels go through Pillow's ImageCms, deeper ones through imagecodecs, since
Pillow has no RGB of 16 bits. A profile that changes no 8-bit colour by more than one step is sRGB's
own, and is not applied.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from xrgs.safeio.sanitize import for_line

Samples = NDArray[Any]
"""Pixels [H, W, 1, 3 or 4] of uint8 or uint16: grey, RGB or CMYK."""

_INTENT = ImageCms.Intent.RELATIVE_COLORIMETRIC
_BLACK_POINT = ImageCms.Flags.BLACKPOINTCOMPENSATION
#: Makes LittleCMS compute each colour, which takes ten times as long. Without this flag it
#: interpolates in a table of 33 steps, and errs by up to 14 of 255 at the gamut's edges; 8-bit
#: pixels of matrix profiles and of grey are exact in both cases.
_EXACT = ImageCms.Flags.NOOPTIMIZE
#: Number of channels -> Pillow's mode.
_MODES = {1: "L", 3: "RGB", 4: "CMYK"}
#: The largest change of an 8-bit colour by a profile that counts as sRGB's: its copies round
#: differently.
_ROUNDING = 1

Chromaticities = tuple[float, float, float, float, float, float, float, float]
"""x and y of white, red, green and blue, as in a PNG's cHRM."""
SRGB: Chromaticities = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
_ADOBE: Chromaticities = (0.3127, 0.329, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)
#: ColourPrimaries of ITU-T H.273 -> name and chromaticities, without sRGB's.
_H273_PRIMARIES: dict[int, tuple[str, Chromaticities]] = {
    4: ("BT.470 M", (0.31, 0.316, 0.67, 0.33, 0.21, 0.71, 0.14, 0.08)),
    5: ("BT.601 of 625 lines", (0.3127, 0.329, 0.64, 0.33, 0.29, 0.6, 0.15, 0.06)),
    6: ("BT.601 of 525 lines", (0.3127, 0.329, 0.63, 0.34, 0.31, 0.595, 0.155, 0.07)),
    7: ("SMPTE 240M", (0.3127, 0.329, 0.63, 0.34, 0.31, 0.595, 0.155, 0.07)),
    8: ("generic film", (0.31, 0.316, 0.681, 0.319, 0.243, 0.692, 0.145, 0.049)),
    9: ("BT.2020", (0.3127, 0.329, 0.708, 0.292, 0.17, 0.797, 0.131, 0.046)),
    10: ("CIE XYZ", (1 / 3, 1 / 3, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0)),
    11: ("DCI-P3", (0.314, 0.351, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)),
    12: ("Display P3", (0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)),
    22: ("EBU Tech 3213", (0.3127, 0.329, 0.63, 0.34, 0.295, 0.605, 0.155, 0.077)),
}
#: ColourPrimaries that are sRGB's (1), or that say that the primaries are unknown.
_H273_SRGB_PRIMARIES = (0, 1, 2, 3)
#: Curves of H.273 that are decoded as sRGB's: its own, and the similar ones of cameras for BT.709
#: and its relatives. 0, 2 and 3 say that the curve is unknown.
_H273_SRGB = (0, 1, 2, 3, 6, 11, 12, 13, 14, 15)
#: Curves of H.273 that are powers -> the exponent that decodes a value.
_H273_GAMMA = {4: 2.2, 5: 2.8, 8: 1.0}
_H273_SMPTE_240M, _H273_SMPTE_428 = 7, 17
#: Curves of H.273 that are refused -> their names in messages.
_H273_REFUSED = {
    9: "logarithmic brightness",
    10: "logarithmic brightness",
    16: "HDR (PQ)",
    18: "HDR (HLG)",
}
#: The largest difference in x or y, and the largest relative difference of the curve's exponent,
#: at which a PNG's colours count as sRGB's, rounded.
_SAME_XY, _SAME_GAMMA = 0.005, 0.05

_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


class ColourError(ValueError):
    """The colours of a photograph can't be converted."""


@dataclass(frozen=True)
class Encoding:
    """The colours of a file that names its primaries and curve, and has no ICC profile."""

    name: str
    primaries: Chromaticities = SRGB
    gamma: float | None = None
    """The exponent that decodes a value; None is sRGB's curve."""
    smpte: int | None = None
    """H.273's number of the curve SMPTE 240M or ST 428-1, which replaces `gamma`."""
    narrow_bits: int = 0
    """Bits per value if values have video's narrow range (at 8 bits, black is 16 and white 235); 0
    for the full range."""


def from_h273(primaries: int, transfer: int, narrow_bits: int = 0) -> Encoding | None:
    """Return the colours that a HEIC file, a video or a PNG's cICP names by ITU-T H.273's numbers.

    None for full-range sRGB, or if the file says that its colours are unknown. `narrow_bits` is as
    in `Encoding`.

    Raises:
        ColourError: The curve is HDR, which has no white to scale by, or logarithmic; or a number
            is unknown to this module.
    """
    if transfer in _H273_REFUSED:
        raise ColourError(f"its brightness is {_H273_REFUSED[transfer]}; save it as SDR")
    powers = transfer in _H273_SRGB or transfer in _H273_GAMMA
    if not powers and transfer not in (_H273_SMPTE_240M, _H273_SMPTE_428):
        raise ColourError(f"its curve is number {transfer} of H.273, not known; save it as sRGB")
    if primaries not in _H273_PRIMARIES and primaries not in _H273_SRGB_PRIMARIES:
        raise ColourError(f"its primaries are number {primaries} of H.273, not known")
    name, xy = _H273_PRIMARIES.get(primaries, ("sRGB", SRGB))
    if transfer in _H273_SRGB and xy == SRGB and not narrow_bits:
        return None
    gamma = _H273_GAMMA.get(transfer)
    smpte = None if powers else transfer
    curve = {1.0: "linear ", None: ""}.get(gamma, f"gamma {gamma} ")
    curve = {_H273_SMPTE_240M: "SMPTE 240M ", _H273_SMPTE_428: "ST 428-1 "}.get(transfer, curve)
    words = f"narrow-range {curve}{name}" if narrow_bits else f"{curve}{name}"
    return Encoding(words, xy, gamma, smpte, narrow_bits)


def adobe_rgb() -> Encoding:
    """Return Adobe RGB (1998): index `R03` in EXIF, or colour space 2 from some cameras."""
    return Encoding("Adobe RGB", _ADOBE, 563 / 256)


def from_png(gamma: float | None, chromaticities: Chromaticities | None) -> Encoding | None:
    """Return the colours of a PNG's gAMA and cHRM; None if they are invalid or close to sRGB's."""
    xy = chromaticities or SRGB
    if np.abs(np.subtract(xy, SRGB)).max() < _SAME_XY or not _is_triangle(xy):
        xy = SRGB
    if gamma is None or not 0.1 < gamma < 5 or abs(gamma * 2.2 - 1) < _SAME_GAMMA:
        return None if xy == SRGB else Encoding("the primaries of cHRM", xy)
    return Encoding(f"gamma {gamma:.3g}", xy, 1 / gamma)


def _is_triangle(xy: Chromaticities) -> bool:
    """Return whether the primaries span a triangle, and every y is above 0."""
    _, (ax, ay), (bx, by), (cx, cy) = zip(xy[::2], xy[1::2], strict=True)
    area = abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay)) / 2
    return min(xy[1::2]) > 0 and area > 0.01


def convert(
    samples: Samples, profile: bytes | None, encoding: Encoding | None
) -> tuple[NDArray[np.float32], str]:
    """Convert the pixels of a photograph to sRGB.

    Args:
        samples: Grey, RGB or CMYK [H, W, 1, 3 or 4]; uint8, or uint16 whose white is 65535. In
            CMYK the largest value is full ink.
        profile: The file's ICC profile.
        encoding: The colours that a file without a profile names.

    Returns:
        RGB [H, W, 3] in 0..1, and a note on the conversion, empty if there was none.
    """
    if profile:
        converted, note = _by_profile(samples, profile)
        if converted is not None:
            return _to_float(converted), note
        return _to_float(_plain_rgb(samples)), note
    if samples.shape[2] == 4:
        return _to_float(_plain_rgb(samples)), "converted from CMYK without a profile"
    rgb = _to_float(_plain_rgb(samples))
    if encoding is None:
        return rgb, ""
    return _by_encoding(rgb, encoding), f"converted from {encoding.name} to sRGB"


def _to_float(samples: Samples) -> NDArray[np.float32]:
    most = np.float32(np.iinfo(samples.dtype).max)
    return np.divide(samples, most, dtype=np.float32)


def _plain_rgb(samples: Samples) -> Samples:
    """Convert grey and CMYK to RGB [H, W, 3] as Pillow does."""
    if samples.shape[2] == 4 and samples.dtype == np.uint8:
        return np.asarray(_image(samples, "CMYK").convert("RGB"))
    if samples.shape[2] == 4:  # Pillow's formula
        light = 1 - samples / 65535
        return np.round(light[..., :3] * light[..., 3:] * 65535).astype(np.uint16)
    return np.broadcast_to(samples, (*samples.shape[:2], 3))


def _by_profile(samples: Samples, profile: bytes) -> tuple[Samples | None, str]:
    """Convert by an ICC profile; None if the profile is sRGB's own or can't be used."""
    mode = _MODES[samples.shape[2]]
    transform, note = _transform(profile, mode)
    if transform is None:
        return None, note
    if samples.dtype == np.uint8:
        return _applied(transform, samples, mode), note
    import imagecodecs

    converted: NDArray[np.uint16] = imagecodecs.cms_transform(
        np.ascontiguousarray(samples[..., 0] if mode == "L" else samples),
        profile,
        _srgb().tobytes(),
        colorspace={"L": "gray"}.get(mode, mode.lower()),
        outcolorspace="rgb",
        intent=int(_INTENT),
        flags=int(_BLACK_POINT | _EXACT),
    )
    return converted, note


@lru_cache(maxsize=8)
def _transform(profile: bytes, mode: str) -> tuple[Any, str]:
    """Return Pillow's transform from a profile to sRGB and a note.

    The transform is None if the profile is sRGB's own, is damaged, or is for another colour space
    than the image's.
    """
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        grey_of_rgb = mode == "L" and source.profile.xcolor_space == "RGB "
        input_mode = "RGB" if grey_of_rgb else mode
        is_quick = source.profile.is_matrix_shaper or mode == "L"
        flags = _BLACK_POINT if is_quick else _BLACK_POINT | _EXACT
        transform = ImageCms.buildTransform(source, _srgb(), input_mode, "RGB", _INTENT, flags)
        name = for_line(ImageCms.getProfileDescription(source), 60).strip() or "its profile"
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return None, "ICC profile ignored, since it is damaged or of another colour space"
    if input_mode != "CMYK":
        probe = _probe(input_mode)
        change = _applied(transform, probe, input_mode) - probe.astype(np.float32)
        if np.abs(change).max() <= _ROUNDING:
            return None, ""
    if grey_of_rgb:
        return None, f"ICC profile {name} ignored, since it is of RGB and the image is grey"
    return transform, f"converted from {name} to sRGB"


def _applied(transform: Any, samples: Samples, mode: str) -> NDArray[np.uint8]:
    return np.asarray(ImageCms.applyTransform(_image(samples, mode), transform))


def _image(samples: Samples, mode: str) -> Image.Image:
    pixels = np.ascontiguousarray(samples[..., 0] if mode == "L" else samples)
    return Image.frombuffer(mode, (samples.shape[1], samples.shape[0]), pixels)


def _probe(mode: str) -> NDArray[np.uint8]:
    """Return a grid of test colours [1, N, 1 or 3], between which profiles are smooth."""
    if mode == "L":
        return np.arange(256, dtype=np.uint8)[None, :, None]
    steps = np.linspace(0, 255, 17).astype(np.uint8)
    return np.stack(np.meshgrid(steps, steps, steps), -1).reshape(1, -1, 3)


@lru_cache(maxsize=1)
def _srgb() -> ImageCms.ImageCmsProfile:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))


def from_lab(image: Image.Image) -> NDArray[np.uint8]:
    """Convert an image of Pillow's mode LAB to RGB [H, W, 3]."""
    lab = ImageCms.createProfile("LAB")
    flags = _BLACK_POINT | _EXACT
    transform = ImageCms.buildTransform(lab, _srgb(), "LAB", "RGB", _INTENT, flags)
    return np.asarray(ImageCms.applyTransform(image, transform))


def _by_encoding(rgb: NDArray[np.float32], encoding: Encoding) -> NDArray[np.float32]:
    """Decode by the curve, change the primaries, encode by sRGB's curve, and clip to 0..1."""
    if encoding.narrow_bits:
        eighth_bits = np.float32((2**encoding.narrow_bits - 1) / 2 ** (encoding.narrow_bits - 8))
        rgb = np.clip((rgb * eighth_bits - 16) / 219, 0, 1)
    matrix = np.linalg.inv(_to_xyz(SRGB)) @ _to_xyz(encoding.primaries)
    linear = np.clip(_linear(rgb, encoding) @ matrix.T.astype(np.float32), 0, 1)
    dark = linear <= 0.0031308
    encoded: NDArray[np.float32] = np.where(
        dark, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
    )
    return encoded.astype(np.float32)


def _linear(rgb: NDArray[np.float32], encoding: Encoding) -> NDArray[np.float32]:
    """Decode values in 0..1 by the curve of an encoding; white is 1."""
    linear: NDArray[np.float32]
    if encoding.smpte == _H273_SMPTE_240M:
        linear = np.where(rgb < 4 * 0.0228, rgb / 4, ((rgb + 0.1115) / 1.1115) ** (1 / 0.45))
    elif encoding.smpte == _H273_SMPTE_428:  # of cinemas: white has 48 cd/m², the most is 52.37
        linear = np.minimum(52.37 / 48 * rgb**2.6, 1)
    elif encoding.gamma is None:
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    else:
        linear = rgb**encoding.gamma
    return linear


def _to_xyz(xy: Chromaticities) -> NDArray[np.float64]:
    """Return the matrix [3, 3] from linear RGB to XYZ, adapted to sRGB's white (Bradford)."""
    white, *primaries = zip(xy[::2], xy[1::2], strict=True)
    columns = np.array([(x, y, 1 - x - y) for x, y in primaries]).T
    matrix = columns * np.linalg.solve(columns, _xyz(*white))
    cones, target = _BRADFORD @ _xyz(*white), _BRADFORD @ _xyz(*SRGB[:2])
    adapted: NDArray[np.float64] = np.linalg.solve(
        _BRADFORD, (target / cones)[:, None] * (_BRADFORD @ matrix)
    )
    return adapted


def _xyz(x: float, y: float) -> NDArray[np.float64]:
    return np.array([x / y, 1, (1 - x - y) / y])
