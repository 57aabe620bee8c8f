"""Files from strangers: nothing is run, nothing outside is touched, nothing grows or hangs."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from xrgs.capture import images
from xrgs.capture.images import ImageError
from xrgs.evaluation.lpips import weights
from xrgs.evaluation.lpips.weights import WeightsError
from xrgs.safeio import npz, untrusted
from xrgs.training.checkpoint import Checkpoint, CheckpointError

FAST = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
#: What is done to valid bytes: at a place, so many are replaced by these.
CHANGES = st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=12))


def changed(content: bytes, change: tuple[float, int, bytes]) -> bytes:
    share, count, new = change
    place = int(share * len(content))
    return content[:place] + new + content[place + count :]


def test_only_a_regular_file_of_bearable_size_is_read(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"abc")
    assert untrusted.read_bytes(file) == b"abc"
    (tmp_path / "link").symlink_to(file)
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe", ".", "none"):
        with pytest.raises(OSError, match=rf"{name}|{tmp_path.name}"):
            untrusted.read_bytes(tmp_path / name)
    with pytest.raises(OSError, match="at most 2 are read"):
        untrusted.read_bytes(file, 2)


@pytest.mark.parametrize(
    "name", ["a", "a b", "..a", "-x", "部屋", "é", "🙂👨‍👩‍👧", "%41", "x" * 251, "a=b,c'\""]
)
def test_a_name_may_be_odd(name: str) -> None:
    assert untrusted.is_name(name)
    assert untrusted.is_inside(f"{name}/{name}")


@pytest.mark.parametrize(
    "name",
    ["", ".", "..", "a/b", "/a", "a\\b", "a\nb", "a\0", "\x1b[2J", "\ud800", "x" * 252, 1, None],
)
def test_a_name_leads_nowhere(name: object) -> None:
    assert not untrusted.is_name(name)


@pytest.mark.parametrize("path", ["", "/", "a/", "/a", "../a", "a/../b", "a/./b", "a//b", None])
def test_a_path_stays_inside(path: object) -> None:
    assert not untrusted.is_inside(path)


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 100_000,
        b"[" * 60 + b"]" * 60,
        b'{"a":' * 60 + b"1" + b"}" * 60,
        b'"\\ud800"',
        b"\xff",
        b"1" * 5000,
    ],
)
def test_json_that_nobody_can_handle_is_refused(content: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - json's own messages
        untrusted.parse_json(content)


def test_json_is_read() -> None:
    value = {"a": [{"b": 1.5}] * 99, "c": "🙂", "d": None}
    for ascii_only in (False, True):
        assert untrusted.parse_json(json.dumps(value, ensure_ascii=ascii_only).encode()) == value


def test_of_a_link_the_link_is_removed(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "link").symlink_to("precious")
    untrusted.remove(tmp_path / "link")
    untrusted.remove(tmp_path / "none")
    assert [entry.name for entry in tmp_path.iterdir()] == ["precious"]
    untrusted.remove(tmp_path / "precious")
    assert not list(tmp_path.iterdir())


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


def test_arrays_come_back_as_they_were() -> None:
    found = npz.read(io.BytesIO(packed(**ARRAYS)))
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert np.array_equal(found[name], array)
        assert found[name].flags.writeable


def header(text: str) -> bytes:
    """A .npz of one member, whose header says this, and 8 bytes."""
    line = text.encode().ljust(117) + b"\n"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00\x76\x00" + line + bytes(8))
    return stream.getvalue()


def overlapping() -> bytes:
    """Nine members that are all the same 100 kB."""
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
        (header("{'descr':'<f8','fortran_order':False,'shape':(1000000000000,)}"), "what follows"),
        (header("{'descr':'<f8','fortran_order':False,'shape':(-1,-1)}"), "negative"),
        (header("{'descr':'|V0','fortran_order':False,'shape':(1000000000000,)}"), "what follows"),
        (header("{'descr':'|O','fortran_order':False,'shape':(1,)}"), "what follows"),
        (header("__import__('os').mkdir('trap')"), "malformed node"),
        (packed(a=np.array([{}], object)), "what follows"),
        (overlapping(), "larger than it"),
        (b"", "not a zip file"),
        (b"PK", "not a zip file"),
    ],
)
def test_an_archive_that_promises_more_than_it_has_is_refused(content: bytes, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        npz.read(io.BytesIO(content))
    assert not Path("trap").exists()


@FAST
@given(change=CHANGES)
def test_a_damaged_archive_is_read_or_refused_and_nothing_else(change: Any) -> None:
    content = changed(packed(**ARRAYS), change)
    try:
        found = npz.read(io.BytesIO(content))
    except ValueError:
        return
    assert sum(array.nbytes for array in found.values()) <= len(content)


@FAST
@given(content=st.binary(max_size=200), zipped=st.booleans())
def test_bytes_in_place_of_weights_or_a_checkpoint_are_named(
    tmp_path: Path, content: bytes, zipped: bool
) -> None:
    file = tmp_path / "w.npz"
    file.write_bytes(b"PK\x03\x04" * zipped + content)
    with pytest.raises(WeightsError, match=r"w\.npz"):
        weights.load(file)
    with pytest.raises(CheckpointError, match=r"w\.npz"):
        Checkpoint(file).load()


def test_weights_larger_than_weights_are_not_read(tmp_path: Path) -> None:
    with (tmp_path / "w.npz").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(WeightsError, match=r"w\.npz: can't be read.*at most"):
        weights.load(tmp_path / "w.npz")


def photograph(kind: str) -> bytes:
    stream = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112], exif[0x0110] = 6, "a camera"
    Image.linear_gradient("L").resize((40, 30)).convert("RGB").save(stream, kind, exif=exif)
    return stream.getvalue()


PHOTOGRAPHS = {kind: photograph(kind) for kind in ("PNG", "JPEG", "TIFF", "WEBP")}


@FAST
@given(kind=st.sampled_from(sorted(PHOTOGRAPHS)), change=CHANGES)
@pytest.mark.filterwarnings("ignore:.*:UserWarning:PIL")
def test_a_damaged_photograph_is_read_or_named(tmp_path: Path, kind: str, change: Any) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(changed(PHOTOGRAPHS[kind], change))
    for reader in (images.size, images.camera_mark, images.read):
        try:
            reader(file)
        except ImageError as error:
            assert str(file) in str(error)  # noqa: PT017 - or it is read


def test_a_program_in_place_of_a_photograph_is_not_run(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    Image.new("RGB", (9, 9)).save(file, "EPS")
    with pytest.raises(ImageError, match=r"a\.png"):
        images.read(file)


def bomb(width: int, height: int) -> bytes:
    """The start of a PNG that says it is this large."""
    stream = io.BytesIO()
    Image.new("L", (1, 1)).save(stream, "PNG")
    content = stream.getvalue()
    size = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    head = b"IHDR" + size + content[24:29]
    return content[:12] + head + zipfile.crc32(head).to_bytes(4, "big") + content[33:]


def test_a_picture_of_more_pixels_than_any_is_refused_by_its_header(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(bomb(1 << 20, 1 << 20))
    for reader in (images.size, images.read):
        with pytest.raises(ImageError, match=r"a\.png.*decompression bomb"):
            reader(tmp_path / "a.png")
