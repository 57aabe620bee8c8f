"""Variants that declare what they don't have: views, files, points."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile.looks import Look, Maker, all_looks, inspect
from tests.hostile.reference import cell_of, edit, ply, seal, seal_variant, variant_of

Variant = dict[str, Any]


def npy(descr: str, shape: tuple[int, ...], body: bytes = b"", version: int = 1) -> bytes:
    """A member of an .npz with any header."""
    header = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY" + bytes((version, 0)) + struct.pack("<H", len(header)) + header + body


def _npz(members: Mapping[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


class _Touch:
    """A pickle that would make a file when it is read."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.file}",)


_COLORS = npy("|u1", (1, 3), bytes(3))


def _points(points: bytes, colors: bytes = _COLORS, compression: int = 0) -> bytes:
    return _npz({"points.npy": points, "colors.npy": colors}, compression)


def _overlapping() -> bytes:
    """1,000 members whose entries all point to one megabyte."""
    body = npy("<f8", (1 << 17,), bytes(1 << 20))
    one = _npz({"points.npy": body})
    start = one.index(b"PK\x01\x02")
    entry = one[start : one.index(b"PK\x05\x06")]
    entries = b"".join(
        entry.replace(b"points.npy", b"p%05d.npy" % number) for number in range(1000)
    )
    end = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, 1000, 1000, len(entries), start, 0)
    return one[:start] + entries + end


def _pickled(canary: Path) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array([_Touch(canary)], dtype=object), allow_pickle=True)
    return _npz({"points.npy": stream.getvalue(), "colors.npy": stream.getvalue()})


def _evaluated(canary: Path) -> bytes:
    code = f"__import__('os').system('touch {canary}')".encode().ljust(199) + b"\n"
    return _points(b"\x93NUMPY\1\0" + struct.pack("<H", len(code)) + code)


_ARCHIVES: Mapping[str, Callable[[Path], bytes]] = {
    "a pickle": _pickled,
    "nothing but a pickle": lambda canary: pickle.dumps(_Touch(canary)),
    "a header that is code": _evaluated,
    "a name outside": lambda _: _npz({"../../../OUTSIDE/x.npy": npy("<f8", (1, 3), bytes(24))}),
    "1 GB compressed": lambda _: _points(
        npy("<f8", (40_000_000, 3), bytes(960_000_000)), compression=zipfile.ZIP_DEFLATED
    ),
    "10^15 points": lambda _: _points(npy("<f8", (10**15, 3))),
    "a negative shape": lambda _: _points(npy("<f8", (-1, -3), bytes(24))),
    "10,000 dimensions": lambda _: _points(npy("<f8", (1,) * 10_000, bytes(8))),
    "not a number": lambda _: _points(npy("<f8", (1, 3), struct.pack("<3d", *[float("nan")] * 3))),
    "the other byte order": lambda _: _points(npy(">f8", (1, 3), bytes(24))),
    "no points": lambda _: _points(npy("<f8", (0, 3)), npy("|u1", (0, 3))),
    "far points": lambda _: _points(
        npy("<f8", (1000, 3), struct.pack("<d", 1e300) * 3000), npy("|u1", (1000, 3), bytes(3000))
    ),
    "overlapping members": lambda _: _overlapping(),
    "100,000 members": lambda _: _npz({f"a{number}.npy": b"" for number in range(100_000)}),
    "a name of escapes": lambda _: _npz({"\x1b]0;owned\x07.npy": b"x"}),
    "format 3": lambda _: _points(npy("<f8", (1, 3), bytes(24), version=3)),
    "not an archive": lambda _: b"PK\x03\x04" + bytes(100),
    "nothing": lambda _: b"",
}


def _archive(make: Callable[[Path], bytes], store: Path, *, listed: bool) -> list[Look]:
    folder = variant_of(store)
    (folder / "points.npz").write_bytes(make(store.with_name("canary")))
    if listed:
        folder = seal_variant(folder)
    return [inspect(folder), *all_looks(store, done=None, planned=listed)]


def _views(values: Mapping[str, Any]) -> Callable[[Variant], None]:
    def change(variant: Variant) -> None:
        for view in variant["views"]:
            view.update(values)

    return change


def _updated(values: Mapping[str, Any]) -> Callable[[Variant], None]:
    return lambda variant: variant.update(values)


def _many_views(variant: Variant) -> None:
    view = variant["views"][0]
    variant["views"] = [view | {"name": f"view {number}"} for number in range(100_000)]


def _many_files(variant: Variant) -> None:
    names = {f"images/train/{number}.png": "0" * 64 for number in range(200_000)}
    variant["files"] = variant["files"] | names


def _file_outside(variant: Variant) -> None:
    variant["files"]["../../../OUTSIDE/victim.txt"] = "0" * 64
    variant["views"][0]["file"] = "../../../OUTSIDE/victim.txt"


_CHANGES: Mapping[str, Callable[[Variant], None]] = {
    "a view outside": _views({"file": "../../../OUTSIDE/x.png"}),
    "a file outside": _file_outside,
    "views of 1e9 px": _views({"width": 10**9, "height": 10**9}),
    "views of 50,000 px": _views({"width": 50_000, "height": 50_000}),
    "views of 10^400 px": _views({"width": 10**400, "height": 1}),
    "views of -1 px": _views({"width": -1, "height": -1}),
    "views of 41 px": _views({"width": 41}),
    "a focal length of 1e308": _views({"K": [[1e308, 0, 0], [0, 1e308, 0], [0, 0, 1]]}),
    "K of a million numbers": _views({"K": [[0.0] * 1000] * 1000}),
    "K of 10^400": _views({"K": [[10**400, 0, 0], [0, 1, 0], [0, 0, 1]]}),
    "rho a text": _views({"rho": "x"}),
    "rho 10^400": _views({"rho": 10**400}),
    "an unknown key": _views({"__class__": "x"}),
    "views a number": _updated({"views": 5}),
    "no views": _updated({"views": []}),
    "views null": _updated({"views": [None]}),
    "files a list": _updated({"files": []}),
    "factor 0": _updated({"factor": 0}),
    "factor 10^400": _updated({"factor": 10**400}),
    "a name of 250 characters": _views({"name": "x" * 250}),
    "100,000 views": _many_views,
    "200,000 files": _many_files,
    "scene of 10 MB": _updated({"scene": "x" * 10_000_000}),
}


def _changed(change: Callable[[Variant], None], store: Path, *, listed: bool) -> list[Look]:
    folder = variant_of(store)
    edit(folder / "variant.json", change)
    if listed:
        folder = seal_variant(folder)
    return [inspect(folder), *all_looks(store, done=None, planned=listed)]


def _report(values: Mapping[str, object], store: Path) -> list[Look]:
    folder = variant_of(store)
    edit(folder / "report.json", lambda report: report.update(values))
    return [inspect(folder)]


_REPORTS: Mapping[str, Mapping[str, object]] = {
    "numbers": {"reprojection_error_px": 1e308, "points": 10**400, "rho": {"HR": [1e308, None]}},
    "types": {"attempts": [1], "not_registered": [[]], "rho": [], "pose_error": 3},
    "100,000 attempts": {"attempts": [{"attempt": "a"}] * 100_000},
    "a million names": {"not_registered": [f"n{number}" for number in range(1_000_000)]},
}


def _splats(content: bytes, store: Path) -> list[Look]:
    """Rerun compares the bytes; the file itself is read by `CellFolder.gaussians` alone."""
    cell = cell_of(store)
    (cell / "splats.ply").write_bytes(content)
    seal(cell)
    return all_looks(store, planned=False)


_VERTICES = np.zeros((2, 17), "<f4")
CASES: Mapping[str, Maker] = {
    **{
        f"points: {what}{'' if listed else ', not listed'}": partial(_archive, make, listed=listed)
        for what, make in _ARCHIVES.items()
        for listed in (True, False)
    },
    **{
        f"{what}{'' if listed else ', not listed'}": partial(_changed, change, listed=listed)
        for what, change in _CHANGES.items()
        for listed in (True, False)
    },
    **{f"report of {what}": partial(_report, values) for what, values in _REPORTS.items()},
    "splats of 10^12 vertices": partial(_splats, ply(_VERTICES, 10**12)),
    "splats of -1 vertices": partial(_splats, ply(_VERTICES, -1)),
    "splats of nothing": partial(_splats, b""),
}
