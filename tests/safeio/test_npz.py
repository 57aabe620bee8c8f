"""Untrusted .npz archives: they give arrays or an error, and nothing in them is run."""

from __future__ import annotations

import io
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xrgs.evaluation.lpips import weights
from xrgs.evaluation.lpips.weights import WeightsError
from xrgs.safeio import npz

ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "by columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "number": np.array(3, np.float32),
    "none": np.zeros((0, 3)),
    "bytes": np.arange(9, dtype=np.uint8),
}


def packed(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **arrays)
    return stream.getvalue()


def test_a_compressed_archive_is_refused() -> None:
    stream = io.BytesIO()
    np.savez_compressed(stream, a=np.zeros(1000))
    with pytest.raises(ValueError, match="compressed"):
        npz.read(stream)


def test_arrays_are_read_as_they_were_written() -> None:
    found = npz.read(io.BytesIO(packed(**ARRAYS)))
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert np.array_equal(found[name], array)
        assert found[name].flags.writeable


def header(text: str) -> bytes:
    """An archive of one member with this header and 8 bytes of data."""
    line = text.encode().ljust(117) + b"\n"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00\x76\x00" + line + bytes(8))
    return stream.getvalue()


def npy() -> bytes:
    """A valid .npy file."""
    stream = io.BytesIO()
    np.save(stream, np.arange(3))
    return stream.getvalue()


def archive(*members: tuple[str, bytes]) -> bytes:
    """A zip archive of stored members, whose names may be equal."""
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w") as made:
        warnings.simplefilter("ignore", UserWarning)  # of equal names
        for name, content in members:
            made.writestr(name, content)
    return stream.getvalue()


def overlapping() -> bytes:
    """An archive of nine members that all refer to the same 100 kB."""
    content = packed(a=np.zeros(100_000, np.uint8))
    start = content.index(b"PK\x01\x02")
    entry, end = content[start : content.index(b"PK\x05\x06")], content[-22:]
    entries = b"".join(entry.replace(b"a.npy", b"%d.npy" % number) for number in range(9))
    count = (9).to_bytes(2, "little")
    end = end[:8] + count + count + len(entries).to_bytes(4, "little") + end[16:]
    return content[:start] + entries + end


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (
            header("{'descr':'<f8','fortran_order':False,'shape':(1000000000000,)}"),
            "not the data that",
        ),
        (header("{'descr':'<f8','fortran_order':False,'shape':(-1,-1)}"), "negative"),
        (header("{'descr':'|O','fortran_order':False,'shape':(1,)}"), "not the data that"),
        (header("__import__('os').mkdir('trap')"), "malformed node"),
        (packed(a=np.array([{}], object)), "not the data that"),
        (overlapping(), "larger than the archive"),
        (b"", "not a zip file"),
        (archive(("a", npy()), ("a.npy", npy())), "two members of one name"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # archives have the time in them
)
def test_an_archive_that_declares_more_than_it_has_is_refused(content: bytes, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        npz.read(io.BytesIO(content))
    assert not Path("trap").exists()


def test_a_file_too_large_for_weights_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "w.npz").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(WeightsError, match=r"w\.npz: can't be read.*at most"):
        weights.load(tmp_path / "w.npz")
