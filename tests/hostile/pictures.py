"""Images that declare more pixels than they have, decompress a thousandfold or are programs."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from tests.hostile.looks import Look, Maker, cells, inspect, plan, report, status
from tests.hostile.reference import all_cells, edit, seal, seal_variant, variant_of


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)


def png(width: int, height: int, rows: bytes = b"", extra: bytes = b"") -> bytes:
    """An RGB image of 8 bits that declares a size, with any rows."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = _chunk(b"IHDR", header) + extra + _chunk(b"IDAT", zlib.compress(rows, 9))
    return b"\x89PNG\r\n\x1a\n" + body + _chunk(b"IEND", b"")


def _tiff(width: int, height: int) -> bytes:
    tags: tuple[tuple[int, int, int], ...] = (
        (256, 4, width),
        (257, 4, height),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 200),
    )
    tags += ((277, 3, 1), (278, 4, height), (279, 4, 2**31 - 1))
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(300)


def _bmp(width: int, height: int) -> bytes:
    header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 1000, 0, 0, 54) + header + bytes(900)


_EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n"
    b"(/tmp/canary) (w) file\n(%pipe%touch canary) (w) file\n"
)
_TEXT_BOMB = _chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(200_000_000), 9))
_FILES: Mapping[str, Callable[[], bytes]] = {
    "of 100,000 x 100,000": lambda: png(100_000, 100_000, bytes(1000)),
    "of 100,000 x 1": lambda: png(100_000, 1, bytes(300_001)),
    "of 13,000 x 13,000 zeros": lambda: png(13_000, 13_000, bytes(39_001 * 13_000)),
    "of 7,000 x 7,000 zeros": lambda: png(7_000, 7_000, bytes(21_001 * 7_000)),
    "of 2^31": lambda: png(2**31 - 1, 1),
    "of 0 x 0": lambda: png(0, 0),
    "truncated": lambda: png(250, 150, bytes(10)),
    "of a compressed text": lambda: png(40, 30, bytes(121 * 30), _TEXT_BOMB),
    "EPS": lambda: _EPS,
    "SVG": lambda: b'<svg xmlns="http://www.w3.org/2000/svg"></svg>',
    "TIFF of 50,000 x 50,000": lambda: _tiff(50_000, 50_000),
    "BMP of 50,000 x 50,000": lambda: _bmp(50_000, 50_000),
    "empty": lambda: b"",
    "not an image": lambda: b"\xff" * 1000,
}
_DECLARED = {
    "of 100,000 x 100,000": (100_000, 100_000),
    "of 13,000 x 13,000 zeros": (13_000, 13_000),
    "of 7,000 x 7,000 zeros": (7_000, 7_000),
    "of 100,000 x 1": (100_000, 1),
    "TIFF of 50,000 x 50,000": (50_000, 50_000),
    "BMP of 50,000 x 50,000": (50_000, 50_000),
}


@cache
def _content(name: str) -> bytes:
    return _FILES[name]()


def _renders(name: str, store: Path) -> list[Look]:
    """All renders, listed by the cells; each report shows the tables, and says what is missing."""
    for cell in all_cells(store):
        for file in (cell / "renders").iterdir():
            file.write_bytes(_content(name))
        seal(cell)
    return [report(store, drawn=True), status(store), cells(store)]


def _photographs(name: str, store: Path) -> list[Look]:
    """All images of the variant, as the reference store lists others: it has changed."""
    for file in (variant_of(store) / "images").rglob("*.png"):
        file.write_bytes(_content(name))
    looks = [inspect(variant_of(store), ".png"), report(store, drawn=True), status(store)]
    return [*looks, plan(store, done=None)]


def _listed(name: str, store: Path) -> list[Look]:
    """All images of the variant, and the variant lists them, with the sizes of the cameras."""
    folder = variant_of(store)
    for file in (folder / "images").rglob("*.png"):
        file.write_bytes(_content(name))
    sealed = seal_variant(folder)
    return [inspect(sealed, ".png"), status(store)]


def _declared(name: str, store: Path) -> list[Look]:
    """As `_listed`, and the cameras have the size that the images declare."""
    width, height = _DECLARED[name]
    folder = variant_of(store)
    edit(
        folder / "variant.json",
        lambda d: [v.update(width=width, height=height) for v in d["views"]],
    )
    inspected, others = _listed(name, store)
    too_large = max(width, height) > 1 << 16 or width * height > 1 << 26
    return [replace(inspected, names=("variant.json" if too_large else ".png",)), others]


CASES: Mapping[str, Maker] = {
    **{f"renders {name}": partial(_renders, name) for name in _FILES},
    **{f"changed photographs {name}": partial(_photographs, name) for name in _FILES},
    **{f"photographs {name}": partial(_listed, name) for name in _FILES},
    **{f"photographs {name}, as declared": partial(_declared, name) for name in _DECLARED},
}
