"""Gaussians in .spz files, Niantic's compressed format.

Versions 2 and 3 are a gzip stream. Version 4 has the same content in several zstd streams. xrgs
writes version 3, which does not need zstd; docs/export.md lists programs that read it.

Positions are 24-bit fixed-point numbers, unit quaternions have 32 bits, and all other numbers have
8 bits.

The axes are those of the .ply that a file was made from: Niantic's converter and its successors
write coordinates unchanged, against the format's description of its axes. If a file names its axes
(Adobe's extension 0xADBE0003), the Gaussians are rotated to right, down, forward, the axes of .ply
files.
"""

from __future__ import annotations

import gzip
import logging
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.formats.saved import (
    CERTAIN_LOGIT,
    SavedGaussians,
    check_arrays_finite,
    to_gaussians,
    unit_quaternions,
)
from xrgs.formats.similarity import transformed
from xrgs.safeio.atomic import atomic_writer
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.sh import MAX_DEGREE, bases

Bytes = NDArray[np.uint8]

_log = logging.getLogger(__name__)

_MAGIC = 0x5053474E
#: Magic, version, count, degree, fractional bits, flags, and in version 4 the number of streams.
_HEADER = struct.Struct("<IIIBBBB")
_TABLE_PLACE = struct.Struct("<I12x")  # follows the header in version 4
_TABLE_ENTRY = struct.Struct("<QQ")  # bytes of a stream, and of its content
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_MAX_FRACTION = 23  # bits; one of the 24 is the sign
_LOG_SCALES = (-10.0, 255 / 16 - 10)  # least and largest
_COLOR_SCALE = 0.15  # 8 bits then represent band 0 in -3.3..3.3
_LARGEST_PART = 2**-0.5  # limit of the three smaller components of a unit quaternion
_MAX_UNPACKED = 200  # times the file's size; gzip compresses zeros 1000 times
_EXTENSION = struct.Struct("<II")  # its type, and the bytes of its content
_MAX_EXTENSIONS = 1 << 20  # bytes
_AXES_EXTENSION = 0xADBE0003
_MOST_AXES = 16


def write_spz(path: Path, gaussians: Gaussians, *, antialiased: bool = False) -> None:
    """Write Gaussians to a .spz file of version 3, which is replaced atomically.

    Values outside the format's range are clamped, and a warning counts these Gaussians: scales
    outside e^-10 to e^5.9, band 0 coefficients outside -3.3..3.3, coefficients of higher bands
    outside -1..1, coordinates beyond 8 million. The file has the axes of the Gaussians' world,
    without rotation.

    Raises:
        XrgsError: A parameter is NaN, or a position, quaternion or coefficient is infinite; the
            message names it.
    """
    means, scales, sh0, shN = (
        value.detach().double().numpy()
        for value in (gaussians.means, gaussians.scales, gaussians.sh0, gaussians.shN)
    )
    quats = unit_quaternions(gaussians.quats)
    alpha = gaussians.opacities.detach().double().sigmoid().numpy()
    values = (means, quats, scales.clip(*_LOG_SCALES), alpha, sh0, shN)
    check_arrays_finite(path, dict(zip(PARAMETERS, values, strict=True)))
    degree = round((shN.shape[1] + 1) ** 0.5) - 1
    _, exponent = np.frexp(np.abs(means).max(initial=0))  # the largest is below 2^exponent
    bits = int(np.clip(_MAX_FRACTION - 1 - exponent, 0, _MAX_FRACTION))  # after the binary point
    flags = _ANTIALIASED if antialiased else 0
    limit = 2**_MAX_FRACTION - 1
    fixed = (means * 2.0**bits).round()
    stored = {
        "colours": (sh0 * _COLOR_SCALE + 0.5) * 255,
        "scales": (scales + 10) * 16,
        "harmonics": shN * 128 + 128,
    }
    _warn_of_clipped(
        path,
        {"coordinates": (fixed, -limit, limit)}
        | {name: (values, -1, 256) for name, values in stored.items()},
    )
    colors, log_scales, harmonics = (_to_bytes(values).tobytes() for values in stored.values())
    content = [
        _HEADER.pack(_MAGIC, 3, len(means), degree, bits, flags, 0),
        fixed.clip(-limit, limit).astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3].tobytes(),
        _to_bytes(alpha * 255).tobytes(),
        colors,
        log_scales,
        _packed_quaternions(quats).tobytes(),
        harmonics,
    ]
    with atomic_writer(path) as file:
        file.write(gzip.compress(b"".join(content), compresslevel=6, mtime=0))


def _warn_of_clipped(
    path: Path, stored: Mapping[str, tuple[NDArray[np.float64], float, float]]
) -> None:
    """Warn with the number of Gaussians that have a value outside the format's range.

    `stored` is name -> (values [N, ...], least, largest).
    """
    for name, (values, least, most) in stored.items():
        axes = tuple(range(1, values.ndim))
        beyond = ((values < least) | (values > most)).any(axis=axes)
        if count := beyond.sum():
            _log.warning(
                "%s: the %s of %d of %d Gaussians are beyond what .spz holds, and are set to the"
                " nearest values that it does; .ply holds all",
                path,
                name,
                count,
                len(values),
            )


def _to_bytes(values: NDArray[np.float64]) -> Bytes:
    return np.asarray(values.round().clip(0, 255).astype(np.uint8))


def _packed_quaternions(quats: NDArray[np.float64]) -> NDArray[Any]:
    """Pack unit quaternions [N, 4] wxyz: the index of the largest component, and the other three.

    Each of the three has 10 bits; the highest is the sign. The largest component is made positive.
    """
    xyzw = quats[:, [1, 2, 3, 0]]
    rows = np.arange(len(xyzw))
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(xyzw[rows, largest] < 0, -1.0, 1.0)[:, None]
    packed: NDArray[Any] = largest.astype("<u4")
    for component in range(4):
        value = xyzw[:, component]
        magnitude = np.floor(511 * np.abs(value) / _LARGEST_PART + 0.5).clip(0, 511)
        bits = magnitude.astype("<u4") | ((value < 0).astype("<u4") << 9)
        is_stored = component != largest
        packed[is_stored] = (packed[is_stored] << 10) | bits[is_stored]
    return packed


def read_spz(path: Path) -> SavedGaussians:
    """Read the Gaussians of a .spz file of version 2, 3 or 4; bands above 3 are left out.

    Raises:
        XrgsError: The file can't be read, is damaged or of another version, or is of version 4 and
            zstandard is not installed. The message names the file.
    """
    try:
        with path.open("rb") as file:
            content = file.read()
        return _read(path, content)
    except OSError as error:
        raise XrgsError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, zlib.error, struct.error) as error:
        raise XrgsError(f"{path}: is a damaged .spz: {error}") from error


def _read(path: Path, content: bytes) -> SavedGaussians:
    is_packed = content[:4] != _MAGIC.to_bytes(4, "little")  # before version 4
    stream = zlib.decompressobj(wbits=31)  # 31: gzip
    header = stream.decompress(content, _HEADER.size) if is_packed else content
    magic, version, count, degree, fraction, flags, streams = _HEADER.unpack_from(header)
    if magic != _MAGIC or version not in ({2, 3} if is_packed else {4}) or degree > 4:
        raise ValueError(f"its header says version {version} and degree {degree}")
    widths = [9, 1, 3, 3, 3 if version == 2 else 4, 3 * (bases(degree) - 1)]
    size = count * sum(widths)
    if size > _MAX_UNPACKED * len(content):
        raise ValueError(f"{count} Gaussians do not fit in {len(content)} bytes")
    if not is_packed:
        body = b"".join(_streams(path, content, streams, size))
        (table,) = _TABLE_PLACE.unpack_from(content, _HEADER.size)
        extensions = content[_HEADER.size + _TABLE_PLACE.size : table]
    else:
        body = stream.decompress(stream.unconsumed_tail, size) if size else b""
        extensions = stream.decompress(stream.unconsumed_tail, _MAX_EXTENSIONS)
    if len(body) != size:
        raise ValueError(f"has {len(body)} of its {size} bytes")
    axes = _named_axes(path, extensions) if flags & _EXTENDED else 0
    if degree > MAX_DEGREE:
        _log.warning("%s: bands of the harmonics above %d are left out", path, MAX_DEGREE)
    ends = np.cumsum([count * width for width in widths])[:-1]
    parts = np.split(np.frombuffer(body, np.uint8), ends)
    rows = [part.reshape(count, width) for part, width in zip(parts, widths, strict=True)]
    read = to_gaussians(_unpacked(rows, version, fraction))
    if axes:
        read = transformed(read, _to_ply(axes))
    return SavedGaussians(read, bool(flags & _ANTIALIASED))


def _named_axes(path: Path, extensions: bytes) -> int:
    """Return the number of the axes in the file's extensions; 0 if they name no axes."""
    axes, offset = 0, 0
    while offset + _EXTENSION.size <= len(extensions):
        kind, length = _EXTENSION.unpack_from(extensions, offset)
        offset += _EXTENSION.size + length
        if offset > len(extensions):
            raise ValueError("ends within an extension")
        if kind != _AXES_EXTENSION:
            _log.warning("%s: has the extension %#010x, which is not read", path, kind)
            continue
        axes = int.from_bytes(extensions[offset - length : offset], "little")
        if length != 4 or axes > _MOST_AXES:
            raise ValueError(f"its extension {kind:#x} names axes {axes}, not 0 to {_MOST_AXES}")
    return axes


def _to_ply(axes: int) -> NDArray[np.float64]:
    """Return the matrix [4, 4] from a world with numbered axes to right, down, forward.

    As in Niantic's library, the bits of the number minus 1 are: x points right, y up, z forward,
    and an additional quarter turn about x. From 9 on, the library's names of the axes agree with
    its rotations in only four of eight cases; the rotations are implemented here.
    """
    bits = axes - 1
    signs = [1 if bits & 1 else -1, -1 if bits & 2 else 1, 1 if bits & 4 else -1, 1]
    matrix = np.diag(np.array(signs, np.float64))
    if bits & 8:
        matrix = matrix[[0, 2, 1, 3]] * [[1], [1], [-1], [1]]
    return matrix


def _streams(path: Path, content: bytes, count: int, size: int) -> Iterator[bytes]:
    """Yield the content of the streams of version 4, of at most `size` bytes in total."""
    try:
        import zstandard
    except ImportError as error:
        raise XrgsError(
            f"{path}: version 4 of .spz needs zstandard: pip install 'xrgs[spz]'"
        ) from error
    (table,) = _TABLE_PLACE.unpack_from(content, _HEADER.size)
    start, left = table + count * _TABLE_ENTRY.size, size
    for number in range(count):
        packed, length = _TABLE_ENTRY.unpack_from(content, table + number * _TABLE_ENTRY.size)
        if length > left or start + packed > len(content):
            raise ValueError("its streams do not fit")
        left -= length
        try:
            stream = content[start : start + packed]
            # The decompressor allocates the size that the stream claims, even beyond the limit.
            if zstandard.frame_content_size(stream) > length:
                raise ValueError("its streams do not fit")
            yield zstandard.ZstdDecompressor().decompress(stream, length)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
        start += packed


def _unpacked(parts: list[Bytes], version: int, fraction: int) -> dict[str, NDArray[Any]]:
    """Return parameter name -> values."""
    positions, alphas, colors, scales, quats, harmonics = parts
    count = len(alphas)
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[:, :, 1:] = positions.reshape(count, 3, 3)
    fixed = wide.view("<i4")[..., 0] >> 8  # the shift extends the sign
    alpha = torch.from_numpy(alphas[:, 0] / 255.0)
    sh = (
        harmonics.reshape(count, harmonics.shape[1] // 3, 3)[:, : bases(MAX_DEGREE) - 1] - 128.0
    ) / 128.0
    return {
        "means": fixed / 2.0**fraction,
        "opacities": alpha.logit().clamp(-CERTAIN_LOGIT, CERTAIN_LOGIT).numpy(),
        "sh0": ((colors / 255.0 - 0.5) / _COLOR_SCALE)[:, None],
        "scales": scales / 16.0 - 10,
        "quats": _small_quaternions(quats) if version == 2 else _quaternions(quats),
        "shN": sh,
    }


def _quaternions(packed: Bytes) -> NDArray[np.float64]:
    """Unpack quaternions [N, 4] wxyz of version 3, see `_packed_quaternions`."""
    bits = packed.view("<u4")[:, 0]
    largest = bits >> 30
    xyzw = np.zeros((len(bits), 4))
    for component in (3, 2, 1, 0):
        is_stored = component != largest
        value = (bits & 511) * (_LARGEST_PART / 511)
        value = np.where(bits & 512, -value, value)
        xyzw[is_stored, component] = value[is_stored]
        bits = np.where(is_stored, bits >> 10, bits)
    rest = 1 - np.square(xyzw).sum(axis=1)
    xyzw[np.arange(len(bits)), largest] = np.sqrt(rest.clip(0))
    return xyzw[:, [3, 0, 1, 2]]


def _small_quaternions(packed: Bytes) -> NDArray[np.float64]:
    """Unpack quaternions [N, 4] wxyz of version 2: x, y, z have 8 bits each, and w is positive."""
    xyz = packed / 127.5 - 1
    w = np.sqrt((1 - np.square(xyz).sum(axis=1)).clip(0))
    return np.column_stack([w, xyz])
