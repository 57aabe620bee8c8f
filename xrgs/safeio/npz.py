"""Reads an .npz archive of unknown origin into numeric arrays; nothing in it is run or inflated.

`np.load` allocates the size that an array's header declares before it checks how many bytes follow,
and decompresses a thousand bytes out of one. This reader accepts only stored members, as `np.savez`
and our own checkpoints write them, so that the size of the file bounds the memory that is needed.
"""

from __future__ import annotations

import math
import os
import zipfile
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

_HEADER_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
#: The admitted dtype kinds: bool, signed, unsigned and floating; no objects, text or records.
_DTYPE_KINDS = "biuf"
_CHUNK = 1 << 20  # bytes


def read(stream: IO[bytes]) -> dict[str, NDArray[Any]]:
    """Read the arrays of a seekable archive, writable, by member name without `.npy`.

    ValueError says why it is not such an archive.
    """
    try:
        return _read(stream)
    except OSError:
        raise
    except Exception as error:  # zipfile and numpy raise nearly anything for damaged bytes
        raise ValueError(str(error) or type(error).__name__) from error


def _read(stream: IO[bytes]) -> dict[str, NDArray[Any]]:
    size = stream.seek(0, os.SEEK_END)
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("a member of the archive is compressed")
        if sum(member.file_size for member in members) > size:
            raise ValueError("the archive's members claim to be larger than the archive")
        arrays = {m.filename.removesuffix(".npy"): _read_array(archive, m) for m in members}
    if len(arrays) < len(members):
        raise ValueError("the archive has two members of one name")
    return arrays


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    try:
        with archive.open(member) as stream:
            return _parse_npy(stream, member)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{member.filename} is damaged ({error})") from error


def _parse_npy(stream: IO[bytes], member: zipfile.ZipInfo) -> NDArray[Any]:
    """Parse one .npy member, whose header must declare exactly the bytes that follow it."""
    version = npy.read_magic(stream)
    if version not in _HEADER_READERS:
        raise ValueError(f"{member.filename}: .npy format version {version} is not supported")
    shape, fortran_order, dtype = _HEADER_READERS[version](stream)
    data_bytes = member.file_size - stream.tell()
    if dtype.kind not in _DTYPE_KINDS or math.prod(shape) * dtype.itemsize != data_bytes:
        raise ValueError(
            f"{member.filename}: its header declares {dtype} {shape}, which is not the data that "
            "follows it"
        )
    array = np.empty(shape, dtype, order="F" if fortran_order else "C")
    buffer = array.reshape(-1, order="A").view(np.uint8)
    filled = 0
    while chunk := stream.read(_CHUNK):  # to the end, where zipfile compares the checksum
        buffer[filled : filled + len(chunk)] = np.frombuffer(chunk, np.uint8)
        filled += len(chunk)
    return array
