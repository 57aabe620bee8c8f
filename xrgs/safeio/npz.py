"""A .npz from anybody: arrays of numbers, or an error. Nothing in it is run or unpacked.

`np.load` allocates what a header says before it looks whether so much follows, and unpacks a
thousand bytes out of one. Here members are stored, not compressed, as `np.savez` and our own
checkpoints are, so that the file's size bounds the memory.
"""

from __future__ import annotations

import math
import os
import zipfile
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
#: Bool, signed, unsigned, float: no objects, text or records.
_KINDS = "biuf"
_CHUNK = 1 << 20  # bytes


def read(stream: IO[bytes]) -> dict[str, NDArray[Any]]:
    """Every array, by its name without `.npy`.

    Raises:
        OSError: it can't be read.
        ValueError: it is no such archive; the message says why.
    """
    try:
        return _read(stream)
    except OSError:
        raise
    except Exception as error:  # a stranger's bytes lead zipfile and numpy to nearly any
        raise ValueError(str(error) or type(error).__name__) from error


def _read(stream: IO[bytes]) -> dict[str, NDArray[Any]]:
    size = stream.seek(0, os.SEEK_END)
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("a member is compressed")
        if sum(member.file_size for member in members) > size:
            raise ValueError("its members are said to be larger than it")
        arrays = {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    if len(arrays) < len(members):
        raise ValueError("two members of one name")
    return arrays


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    try:
        with archive.open(member) as stream:
            return _content(stream, member)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{member.filename} is damaged ({error})") from error


def _content(stream: IO[bytes], member: zipfile.ZipInfo) -> NDArray[Any]:
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"{member.filename}: .npy of version {version}")
    shape, by_columns, dtype = _HEADERS[version](stream)
    follow = member.file_size - stream.tell()
    if dtype.kind not in _KINDS or math.prod(shape) * dtype.itemsize != follow:
        raise ValueError(f"{member.filename}: {dtype} {shape} is not what follows")
    array = np.empty(shape, dtype, order="F" if by_columns else "C")
    flat = array.reshape(-1, order="A").view(np.uint8)
    done = 0
    while chunk := stream.read(_CHUNK):  # to its end, where the checksum is compared
        flat[done : done + len(chunk)] = np.frombuffer(chunk, np.uint8)
        done += len(chunk)
    return array
