"""Files and ICC profiles that Pillow can't write, made byte by byte."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ImageCms

#: The numbers of EXIF's types.
BYTE, ASCII, SHORT, LONG, FLOAT = 1, 2, 3, 4, 11


def png(
    samples: NDArray[Any],
    *chunks: tuple[bytes, bytes],
    bits: int = 16,
    interlaced: bool = False,
) -> bytes:
    """A PNG of samples [H, W, C]; `chunks` come before the pixels, which are filtered by none."""
    height, width, count = samples.shape
    colour_type = {1: 0, 2: 4, 3: 2, 4: 6}[count]
    stored = samples.astype(">u2" if bits == 16 else "u1")
    passes = [stored]
    if interlaced:  # Adam7
        grids = [(0, 8, 0, 8), (0, 8, 4, 8), (4, 8, 0, 4), (0, 4, 2, 4), (2, 4, 0, 2), (0, 2, 1, 2)]
        passes = [stored[a::b, c::d] for a, b, c, d in (*grids, (1, 2, 0, 1))]
    rows = b"".join(b"\0" + row.tobytes() for part in passes if part.size for row in part)
    head = struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, int(interlaced))
    every = [(b"IHDR", head), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in every
    )


def exif_entry(kind: int, count: int, value: bytes) -> bytes:
    """EXIF of one entry, the orientation."""
    entry = struct.pack("<HHI", 0x0112, kind, count) + value.ljust(4, b"\0")
    return b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + bytes(4)


def with_entry(tiff: bytes, kind: int, count: int, value: bytes) -> bytes:
    """A little-endian TIFF with an orientation in its first directory."""
    start = struct.unpack("<I", tiff[4:8])[0]
    number = struct.unpack("<H", tiff[start : start + 2])[0]
    entries = [tiff[start + 2 + 12 * i : start + 14 + 12 * i] for i in range(number)]
    entries.append(struct.pack("<HHI", 0x0112, kind, count) + value.ljust(4, b"\0"))
    entries.sort(key=lambda entry: struct.unpack("<H", entry[:2])[0])
    padded = tiff + bytes(len(tiff) % 2)
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    return padded[:4] + struct.pack("<I", len(padded)) + padded[8:] + directory


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
#: Primaries in the profile connection space (D50), as Apple's and Adobe's profiles have them.
DISPLAY_P3 = (
    (0.51512, 0.24120, -0.00105),
    (0.29198, 0.69225, 0.04189),
    (0.15710, 0.06657, 0.78407),
)
ADOBE_RGB = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))


def _description(text: bytes) -> bytes:
    body = b"desc" + bytes(4) + struct.pack(">I", len(text) + 1) + text + b"\0"
    return body + bytes(78)


def _numbers(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def _curve(gamma: float) -> bytes:
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256))


def profile(
    name: str, gamma: float, primaries: tuple[tuple[float, float, float], ...] | None = None
) -> bytes:
    """An ICC profile of version 2: of RGB with these primaries, or of grey without."""
    white = b"XYZ " + bytes(4) + _numbers(0.9642, 1, 0.8249)
    tags = [(b"desc", _description(name.encode())), (b"wtpt", white)]
    if primaries is None:
        tags.append((b"kTRC", _curve(gamma)))
    for letter, xyz in zip((b"r", b"g", b"b"), primaries or (), strict=False):
        tags.append((letter + b"XYZ", b"XYZ " + bytes(4) + _numbers(*xyz)))
        tags.append((letter + b"TRC", _curve(gamma)))
    space = b"GRAY" if primaries is None else b"RGB "
    return _assembled(b"mntr", space, b"XYZ ", tags)


def _assembled(
    kind: bytes, space: bytes, connection: bytes, tags: list[tuple[bytes, bytes]]
) -> bytes:
    start = 128 + 4 + 12 * len(tags)
    table, body = b"", b""
    for tag, data in tags:
        table += tag + struct.pack(">II", start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I", start + len(body)) + bytes(4) + b"\x02\x10\0\0" + kind + space
    head += connection + bytes(12) + b"acsp"
    head = head.ljust(68, b"\0") + _numbers(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def cmyk_profile(lab: NDArray[Any]) -> bytes:
    """An ICC profile of CMYK with the colours of all solid inks.

    Args:
        lab: CIELAB in 0..255 [2, 2, 2, 2, 3], by whether there is cyan, magenta, yellow, black.
    """
    ramp = bytes(range(256))
    identity = _numbers(1, 0, 0, 0, 1, 0, 0, 0, 1)
    table = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + identity + 4 * ramp
    table += lab.astype(np.uint8).tobytes() + 3 * ramp
    return _assembled(
        b"prtr", b"CMYK", b"Lab ", [(b"desc", _description(b"inks")), (b"A2B0", table)]
    )
