"""Decodes images of more than 8 bits per channel, which Pillow cuts to 8: PNG, TIFF and HEIC.

Values are scaled to 16 bits: the largest that the file's depth admits becomes 65535. 16-bit files
that use only the low bits, such as raw 12-bit sensor data, are refused, unless they say how many
bits are significant (PNG's sBIT, TIFF's MaxSampleValue).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

_WHITE = 65535
#: If no 16-bit value is larger, the file uses 14 bits or fewer, like cameras' sensors.
_LARGEST_OF_14_BITS = (1 << 14) - 1
_MAX_SAMPLE_VALUE = 281
#: TIFF's photometric interpretations that are read (white is zero, black is zero, RGB, CMYK) and
#: their number of channels.
_MIN_IS_WHITE, _MIN_IS_BLACK, _RGB, _CMYK = 0, 1, 2, 5
_COLOURS = {_MIN_IS_WHITE: 1, _MIN_IS_BLACK: 1, _RGB: 3, _CMYK: 4}
_UNSPECIFIED, _ASSOCIATED = 0, 1  # TIFF's ExtraSamples: no alpha, premultiplied alpha
_SIGNED, _FLOAT = 2, 3  # TIFF's SampleFormat


class RefusedError(ValueError):
    """An intact file that can't be used; the message says why."""


@dataclass(frozen=True)
class Samples:
    """The decoded pixels of a file, before they are converted to sRGB and turned upright."""

    colours: NDArray[np.uint8] | NDArray[np.uint16]
    """[H, W, 1, 3 or 4]: grey, RGB or CMYK; white (or full ink) is the largest value."""
    alpha: NDArray[np.float32] | None
    """[H, W] in 0..1."""
    note: str = ""
    is_upright: bool = False


def decode_png(content: bytes, significant: int) -> Samples:
    """Decode a 16-bit PNG; `significant` is the largest number of bits in its sBIT, else 16."""
    import imagecodecs

    samples: NDArray[np.uint16] = imagecodecs.png_decode(content)
    colours, alpha = _without_alpha(samples, _WHITE)
    scaled, note = _scaled(colours, _WHITE, (1 << significant) - 1)
    return Samples(scaled, alpha, note)


def of_grey(samples: NDArray[Any]) -> Samples:
    """Convert 16-bit grey samples [H, W] that Pillow has decoded."""
    return Samples(_scaled(samples[..., None], _WHITE, _WHITE)[0], None)


def decode_heif(stream: BinaryIO) -> Samples:
    """Decode the primary image of a HEIC file of 10 or 12 bits, upright."""
    import pillow_heif

    image = pillow_heif.open_heif(stream, convert_hdr_to_8bit=False, hdr_to_16bit=False)
    white = (1 << int(image.info["bit_depth"])) - 1
    colours, alpha = _without_alpha(np.asarray(image), white)
    if alpha is not None and image.premultiplied_alpha:
        colours = _unmultiplied(colours, alpha, white)
    return Samples(_scaled(colours, white, white)[0], alpha, is_upright=True)


def _without_alpha(
    samples: NDArray[Any], white: int
) -> tuple[NDArray[Any], NDArray[np.float32] | None]:
    """Separate samples [H, W] or [H, W, 1 to 4] into colours [H, W, 1 or 3], and alpha [H, W]."""
    samples = np.atleast_3d(samples)
    if samples.shape[2] in (1, 3):
        return samples, None
    return samples[..., :-1], _share(samples[..., -1], white)


class Tiff:
    """The first page of a TIFF.

    `bits` per sample; `size` is width and height as stored, before EXIF's turn, px; `channels` is
    the number of samples per pixel.
    """

    def __init__(self, stream: BinaryIO) -> None:
        """Read its tags; the stream must stay open."""
        import tifffile

        # Its warnings of odd tags would reach the terminal.
        logging.getLogger("tifffile").addHandler(logging.NullHandler())
        self._pages = tifffile.TiffFile(stream).pages
        self._page: tifffile.TiffPage = self._pages.first
        self._stream = stream
        self.bits, self.channels = int(self._page.bitspersample), int(self._page.samplesperpixel)
        self.size = self._page.imagewidth, self._page.imagelength
        # Of the first channel after the colours; None if the file doesn't say.
        self._extra = next((int(kind) for kind in self._page.extrasamples), None)

    @property
    def is_deep(self) -> bool:
        """Whether Pillow may lose values: they have more than 8 bits, are signed or float."""
        return self.bits > 8 or self._page.sampleformat in (_SIGNED, _FLOAT)

    @property
    def note(self) -> str:
        """A note if a fourth channel, perhaps alpha, is ignored; else empty."""
        ignored = self._extra == _UNSPECIFIED
        return "a channel ignored, which the file does not call alpha" if ignored else ""

    @property
    def frames(self) -> int:
        """The number of pages."""
        return len(self._pages)

    def value(self, tag: int, default: Any = None) -> Any:
        """Return the value of a tag."""
        return self._page.tags.valueof(tag, default=default)

    def decode(self) -> Samples:
        """Decode the pixels as stored, before EXIF's turn.

        Raises:
            RefusedError: Values are float, signed or of more than 16 bits, or colours are not grey,
                RGB or CMYK.
        """
        page = self._page
        bits, photometric = self.bits, int(page.photometric)
        if page.sampleformat in (_SIGNED, _FLOAT) or bits > 16:
            kind = {_SIGNED: "signed", _FLOAT: "float"}.get(page.sampleformat, "unsigned")
            raise RefusedError(
                f"{kind} values of {bits} bits have no white; save it with 8 or 16 bits"
            )
        if photometric not in _COLOURS:
            name = getattr(page.photometric, "name", photometric)
            raise RefusedError(f"{name} colours of {bits} bits are not read; save it as RGB")
        ends = [a + b for a, b in zip(page.dataoffsets, page.databytecounts, strict=True)]
        if not all(page.databytecounts) or max(ends) > self._stream.seek(0, 2):
            raise ValueError("image file is truncated")
        samples: NDArray[Any] = page.asarray()
        if page.axes == "SYX":
            samples = samples.transpose(1, 2, 0)
        samples = np.atleast_3d(samples)
        white, count = (1 << bits) - 1, _COLOURS[photometric]
        colours, alpha = samples[..., :count], None
        if samples.shape[2] > count and self._extra != _UNSPECIFIED:
            alpha = _share(samples[..., count], white)
            if self._extra == _ASSOCIATED:
                colours = _unmultiplied(colours, alpha, white)
        largest = int(np.max(self.value(_MAX_SAMPLE_VALUE, white)))
        scaled, note = _scaled(colours, white, largest)
        return Samples(_WHITE - scaled if photometric == _MIN_IS_WHITE else scaled, alpha, note)


def _share(values: NDArray[Any], white: int) -> NDArray[np.float32]:
    return values.astype(np.float32) / np.float32(white)


def _unmultiplied(
    colours: NDArray[Any], alpha: NDArray[np.float32], white: int
) -> NDArray[np.uint16]:
    """Divide colours by their alpha."""
    divided = colours / np.maximum(alpha, np.float32(1 / white))[..., None]
    return np.round(np.minimum(divided, white)).astype(np.uint16)


def _scaled(colours: NDArray[Any], white: int, largest: int) -> tuple[NDArray[np.uint16], str]:
    """Scale values so that `white`, or the file's declared `largest`, is 65535; return a note."""
    most = int(colours.max())
    note = ""
    if white == _WHITE and most <= _LARGEST_OF_14_BITS:
        if not most <= largest < white:
            raise RefusedError(
                f"its largest value is {most} of {white}, so that it has {most.bit_length()} bits "
                "in 16 and would be too dark; scale its values to 16 bits"
            )
        white, note = largest, f"scaled from {largest.bit_length()} bits in 16"
    if white == _WHITE:
        return np.ascontiguousarray(colours, dtype=np.uint16), note
    scaled = (colours.astype(np.uint32) * _WHITE + white // 2) // white
    return scaled.astype(np.uint16), note
