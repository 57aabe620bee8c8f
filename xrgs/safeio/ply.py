"""Reads the vertices of a .ply file: ASCII or binary, any properties, among other elements.

Lists, as faces have, are read over only behind the vertices. The file may come from anybody. No
memory is allocated for declared data before the size of the file shows that the data is there.
"""

from __future__ import annotations

import io
import os
import re
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError

MAX_HEADER_BYTES = 1 << 20
#: Vertices whose properties are taken one after the other. They fit in a cache, which is eight
#: times as fast.
_BLOCK = 4096
_NAMES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: The first line, and the last one of the header: lines end with LF, CR LF or, in old files, CR.
_MAGIC = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")
_END = re.compile(rb"\r?\nend_header[ \t]*\r?\n")
_OLD_END = re.compile(rb"\rend_header[ \t]*\r")


@dataclass(frozen=True)
class Ply:
    """The vertices of a .ply file, and its comments."""

    vertices: NDArray[np.void]
    """[V] with a field for each property of the element `vertex`, in the file's types and byte
    order."""
    comments: tuple[str, ...]
    """The comments of the header, without surrounding spaces."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the properties, in the order of the file."""
        return self.vertices.dtype.names or ()

    def columns(self, names: Sequence[str], kind: type[np.floating[Any]]) -> NDArray[Any]:
        """Return properties as an array [V, len(names)]; values that `kind` can't hold are inf."""
        table = np.empty((len(self.vertices), len(names)), kind)
        with np.errstate(over="ignore"):
            for start in range(0, len(table), _BLOCK):
                rows = slice(start, start + _BLOCK)
                for column, name in enumerate(names):
                    table[rows, column] = self.vertices[name][rows]
        return table


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    """Names, and type codes of numpy without the byte order."""
    has_lists: bool = False

    def record(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(name, order + kind) for name, kind in self.properties])


def read(path: Path) -> Ply:
    """Read the vertices of a .ply file; elements before them are skipped.

    Raises:
        XrgsError: The file can't be read, is no .ply, is shorter than its header says, or has lists
            in its vertices or before them; the message names it.
    """
    try:
        with path.open("rb") as file:
            return _read(file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise XrgsError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise XrgsError(f"{path}: {error}") from error


def _read(file: BinaryIO, size: int) -> Ply:
    start = file.read(MAX_HEADER_BYTES)
    magic = _MAGIC.match(start)
    if magic is None:
        raise ValueError("is not a .ply file")
    end = (_OLD_END if magic[1] == b"\r" else _END).search(start, magic.end() - 1)
    if end is None:
        raise ValueError(f"the .ply header has no end in its first {MAX_HEADER_BYTES} bytes")
    header = start[magic.end() : end.start()].decode("utf-8", errors="replace")
    form, elements, comments = _parse_header(re.split(r"\r\n|\n|\r", header) if header else [])
    file.seek(end.end())
    before, vertex = _up_to_vertices(elements)
    if form == "ascii":
        vertices = _read_ascii(file, before, vertex)
    else:
        vertices = _read_binary(file, before, vertex, size, _BYTE_ORDERS[form])
    return Ply(vertices, comments)


def _parse_header(lines: Iterable[str]) -> tuple[str, list[_Element], tuple[str, ...]]:
    """Return the format, the elements and the comments."""
    form, comments = "", []
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case []:  # some programs write blank lines
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(" ".join(line.split(maxsplit=1)[1:]).rstrip())
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and not form:
                form = name
            case ["element", name, count] if re.fullmatch("[0-9]{1,12}", count):
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind]))
            case _:
                raise ValueError(f"unexpected line in the .ply header: {line[:80]!r}")
    if not form:
        raise ValueError("the .ply header names no format")
    return form, elements, tuple(comments)


def _up_to_vertices(elements: list[_Element]) -> tuple[list[_Element], _Element]:
    """Return the elements before the vertices, and the vertices."""
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        has = ", ".join(names)[:80] or "none"
        raise ValueError(f"the .ply header must have one element vertex, its elements are: {has}")
    at = names.index("vertex")
    if lists := [element.name for element in elements[: at + 1] if element.has_lists]:
        raise ValueError(f"the element {lists[0]} has lists, and only those behind vertex may")
    properties = [name for name, _ in elements[at].properties]
    if len(set(properties)) != len(properties):
        raise ValueError("the .ply header names a property of vertex twice")
    if not properties:
        raise ValueError("the .ply header names no properties of vertex")
    return elements[:at], elements[at]


def _read_binary(
    file: BinaryIO, before: list[_Element], vertex: _Element, size: int, order: str
) -> NDArray[np.void]:
    for element in before:
        file.seek(_checked_bytes(file, element, size), os.SEEK_CUR)
    content = file.read(_checked_bytes(file, vertex, size))
    return np.frombuffer(content, vertex.record(order), vertex.count)


def _checked_bytes(file: BinaryIO, element: _Element, size: int) -> int:
    """Return the number of bytes of an element, which must be in the file."""
    needed, remaining = element.count * element.record("=").itemsize, size - file.tell()
    if needed > remaining:
        raise ValueError(
            f"its {element.count} rows of the element {element.name} need {needed} bytes, "
            f"{remaining} are left in the file"
        )
    return needed


def _read_ascii(file: BinaryIO, before: list[_Element], vertex: _Element) -> NDArray[np.void]:
    record = vertex.record("=")
    with io.TextIOWrapper(file, "ascii", errors="replace") as text:
        lines = (line for line in text if not line.isspace())
        for element in before:
            if element.properties:
                deque(islice(lines, element.count), maxlen=0)
        rows = list(islice(lines, vertex.count))
    if len(rows) < vertex.count:
        raise ValueError(f"has {len(rows)} of its {vertex.count} vertices")
    # float64 holds every value of every type of .ply. loadtxt warns where there are no lines.
    width = len(record.names or ())
    values = np.loadtxt(rows, ndmin=2, comments=None) if rows else np.empty((0, width))
    if values.shape[1] != width:
        raise ValueError(f"vertices have {values.shape[1]} values, not {width}")
    return _typed(values, record)


def _typed(values: NDArray[np.float64], record: np.dtype[np.void]) -> NDArray[np.void]:
    """Return the rows of numbers [V, fields] in the types of a record."""
    vertices = np.empty(len(values), record)
    for name, column in zip(record.names or (), values.T, strict=True):
        kind = record[name]
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            is_whole = (column >= limits.min) & (column <= limits.max) & (column == column.round())
            if not is_whole.all():
                row = int(np.argmin(is_whole))
                raise ValueError(f"vertex {row}: {name} is {column[row]:g}, which is no {kind}")
        with np.errstate(over="ignore"):  # a number that float32 can't hold is inf
            vertices[name] = column
    return vertices
