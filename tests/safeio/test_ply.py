"""Vertices of .ply files against the plyfile library, and damaged files."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from xrgs.errors import XrgsError
from xrgs.safeio import ply

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
NAMES = st.from_regex(r"[a-zA-Z_][a-zA-Z_0-9]{0,6}", fullmatch=True)
COMMENTS = st.from_regex(r"[a-z][a-z :0-9]{0,20}[a-z]", fullmatch=True)


@st.composite
def tables(draw: st.DrawFn, *, may_have_lists: bool = True) -> NDArray[np.void]:
    """A table of scalars of any type, and of lists if it may have them, as plyfile takes it."""
    names = draw(st.lists(NAMES, min_size=1, max_size=5, unique=True))
    choices = st.sampled_from([*KINDS, *(["O"] if may_have_lists else [])])
    kinds = [draw(choices) for _ in names]
    table = np.empty(draw(st.integers(0, 4)), list(zip(names, kinds, strict=True)))
    for name, kind in zip(names, kinds, strict=True):
        of = np.dtype("i4" if kind == "O" else kind)  # plyfile's entries
        if kind == "O":
            for row in range(len(table)):
                table[name][row] = draw(arrays.arrays(of, st.integers(0, 3)))
        else:
            table[name] = draw(arrays.arrays(of, len(table)))
    return table


@pytest.mark.slow
@given(
    vertex=tables(may_have_lists=False),
    before=st.lists(tables(may_have_lists=False), max_size=2),
    after=st.lists(tables(), max_size=2),
    comments=st.lists(COMMENTS, max_size=3),
    form=st.sampled_from(["ascii", "<", ">"]),
)
@pytest.mark.filterwarnings("ignore:loadtxt")  # plyfile reads a list of no entries so
@settings(
    max_examples=50,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_what_plyfile_writes_is_read(
    tmp_path: Path,
    vertex: NDArray[np.void],
    before: list[NDArray[np.void]],
    after: list[NDArray[np.void]],
    comments: list[str],
    form: str,
) -> None:
    file = tmp_path / "a.ply"
    elements = [
        PlyElement.describe(table, name)
        for name, table in [
            *((f"before{i}", table) for i, table in enumerate(before)),
            ("vertex", vertex),
            *((f"after{i}", table) for i, table in enumerate(after)),
        ]
    ]
    PlyData(
        elements,
        text=form == "ascii",
        byte_order="=" if form == "ascii" else form,
        comments=comments,
    ).write(file)
    read = ply.read(file)
    oracle = PlyData.read(file)["vertex"]
    assert read.names == vertex.dtype.names
    assert read.comments == tuple(comments)
    assert len(read.vertices) == len(vertex)
    for name in read.names:
        assert read.vertices.dtype[name].newbyteorder("=") == vertex.dtype[name]
        np.testing.assert_array_equal(read.vertices[name], oracle[name])
        np.testing.assert_array_equal(read.vertices[name], vertex[name])


def write(
    file: Path,
    header: str,
    body: bytes = b"",
    *,
    form: str = "binary_little_endian",
    end: str = "\n",
) -> Path:
    lines = ["ply", f"format {form} 1.0", *header.splitlines(), "end_header"]
    file.write_bytes("".join(line + end for line in lines).encode() + body)
    return file


XY = "element vertex 2\nproperty float x\nproperty uchar y"
BODY = np.array([(1.5, 200), (-2, 10)], [("x", "<f4"), ("y", "u1")]).tobytes()


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", " \n"])
@pytest.mark.parametrize(
    ("form", "body"),
    [
        ("binary_little_endian", BODY + b"\n"),
        ("ascii", b"1.5 200\r\n-2  10"),
        ("ascii", b"\n 1.5\t200 \n\n-2.0e0 1e1\n3 4\n"),
        ("ascii", b"1.5 200\r-2 10\r"),
    ],
)
def test_ends_of_lines_and_spaces(tmp_path: Path, end: str, form: str, body: bytes) -> None:
    vertices = ply.read(write(tmp_path / "a.ply", XY, body, form=form, end=end)).vertices
    assert vertices.tolist() == [(1.5, 200), (-2.0, 10)]


def test_blank_lines_of_a_header_are_read_over(tmp_path: Path) -> None:
    header = "comment a\n\nelement vertex 1\n \nproperty uchar x"
    read = ply.read(write(tmp_path / "a.ply", header, b"\x07"))
    assert (read.vertices["x"].tolist(), read.comments) == ([7], ("a",))


def test_a_body_may_begin_with_the_bytes_of_a_line_end(tmp_path: Path) -> None:
    header = "element vertex 1\nproperty uchar x\nproperty uchar y"
    for end in ("\n", "\r\n", "\r"):
        for body in (b"\n\n", b"\r\n", b"\n\r", b"\r\r"):
            read = ply.read(write(tmp_path / "a.ply", header, body, end=end))
            assert read.vertices.tolist() == [tuple(body)]


def test_columns_in_any_byte_order_as_one_array(tmp_path: Path) -> None:
    header = "element vertex 1\nproperty double x\nproperty short y"
    body = np.array([(1e300, -3)], [("x", ">f8"), ("y", ">i2")]).tobytes()
    read = ply.read(write(tmp_path / "a.ply", header, body, form="binary_big_endian"))
    np.testing.assert_array_equal(read.columns(["y", "x"], np.float64), [[-3, 1e300]])
    narrow = read.columns(["y", "x"], np.float32)
    assert narrow.dtype == np.float32
    np.testing.assert_array_equal(narrow, [[-3, np.inf]])


@pytest.mark.parametrize(
    ("header", "body", "message"),
    [
        ("element vertex -5\nproperty float x", b"", "unexpected line .* 'element vertex -5'"),
        ("element vertex ٥\nproperty float x", b"", "unexpected line"),
        ("element vertex 1\nproperty long x", b"", "'property long x'"),
        ("property float x", b"", "'property float x'"),
        ("element face 1\nproperty float x", b"", "one element vertex, its elements are: face"),
        (f"{XY}\n{XY}", b"", "one element vertex, its elements are: vertex, vertex"),
        ("", b"", "its elements are: none"),
        ("element vertex 1", b"", "no properties of vertex"),
        (f"{XY}\nproperty int x", b"", "a property of vertex twice"),
        (XY, BODY[:-1], "2 rows of the element vertex need 10 bytes, 9 are left"),
        (XY.replace("2", "9" * 12), BODY, "need 4999999999995 bytes, 10 are left"),
        (XY.replace("2", "9" * 13), BODY, "unexpected line"),
        ("element a 3\nproperty double b\n" + XY, BODY, "element a need 24 bytes, 10 are left"),
        ("element face 2\nproperty list char int b\n" + XY, b"\0\0" + BODY,
         "the element face has lists, and only those behind vertex may"),
        (f"{XY}\nproperty list uchar int z", BODY, "the element vertex has lists"),
    ],
)  # fmt: skip
def test_damage_is_named(tmp_path: Path, header: str, body: bytes, message: str) -> None:
    file = write(tmp_path / "a.ply", header, body)
    with pytest.raises(XrgsError, match=f"{re.escape(str(file))}: .*{message}"):
        ply.read(file)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"1 2\n", "has 1 of its 2 vertices"),
        (b"1 2 3\n1 2 3\n", "vertices have 3 values, not 2"),
        (b"1 2\n1\n", "columns changed"),
        (b"1 2\n1 x\n", "could not convert string 'x'"),
        (b"1 2\n1 256\n", "vertex 1: y is 256, which is no uint8"),
        (b"1 2.5\n1 2\n", "vertex 0: y is 2.5, which is no uint8"),
        (b"1 nan\n1 2\n", "vertex 0: y is nan, which is no uint8"),
        ("1 2\n1 ٥\n".encode(), "could not convert"),
    ],
)
def test_damaged_text_is_named(tmp_path: Path, body: bytes, message: str) -> None:
    file = write(tmp_path / "a.ply", XY, body, form="ascii")
    with pytest.raises(XrgsError, match=f"{re.escape(str(file))}: .*{message}"):
        ply.read(file)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_memory_is_bounded_by_the_file(tmp_path: Path, form: str) -> None:
    header = f"element a {10**11}\nproperty double a\nelement vertex {10**11}\nproperty double x"
    file = write(tmp_path / "a.ply", header, b"\xff" * 100_000, form=form)
    tracemalloc.start()
    with pytest.raises(XrgsError):
        ply.read(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3_000_000  # of which the buffer of the header is a third
