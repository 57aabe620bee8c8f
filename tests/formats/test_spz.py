"""Gaussians as .spz: to the precision of the format, another program's files, and damaged ones."""

from __future__ import annotations

import gzip
import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from xrgs.errors import XrgsError
from xrgs.formats.ply import load_ply
from xrgs.formats.saved import transformed
from xrgs.formats.spz import read_spz, write_spz
from xrgs.splat.gaussians import PARAMETERS, Gaussians

from .test_glb import FILES, covariances
from .test_ply import make


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "a.spz"


def scene(count: int = 9, degree: int = 3) -> Gaussians:
    """Gaussians whose values the format can hold."""
    gaussians = make(count, degree)
    with torch.no_grad():
        gaussians.shN.clamp_(-0.99, 0.98)
    return gaussians


def assert_near(got: Gaussians, wanted: Gaussians, coordinate: float, harmonic: float) -> None:
    """Compare to half a step of each 8-bit value, and to given errors."""
    torch.testing.assert_close(got.means, wanted.means, atol=coordinate, rtol=0)
    torch.testing.assert_close(got.scales, wanted.scales, atol=1 / 32 + 1e-6, rtol=0)
    torch.testing.assert_close(
        got.opacities.sigmoid(), wanted.opacities.sigmoid(), atol=0.5 / 255 + 1e-6, rtol=0
    )
    torch.testing.assert_close(got.sh0, wanted.sh0, atol=0.5 / 255 / 0.15 + 1e-6, rtol=0)
    torch.testing.assert_close(got.shN, wanted.shN, atol=harmonic, rtol=0)
    # Errors of the scales up to 1/32, and of the quaternions up to 1/1000.
    largest = covariances(wanted).abs().amax((1, 2), keepdim=True)
    assert ((covariances(got) - covariances(wanted)).abs() / largest).max() < 0.08


@pytest.mark.parametrize(("degree", "antialiased"), [(0, True), (3, False)])
def test_what_was_written_is_read(file: Path, degree: int, antialiased: bool) -> None:
    gaussians = scene(degree=degree)
    write_spz(file, gaussians, antialiased=antialiased)
    read = read_spz(file)
    assert read.antialiased == antialiased
    assert_near(read.gaussians, gaussians, 1e-6, 0.5 / 128 + 1e-6)


def test_rotations_are_precise(file: Path) -> None:
    gaussians = scene(500)
    write_spz(file, gaussians)
    got = torch.nn.functional.normalize(read_spz(file).gaussians.quats)
    wanted = torch.nn.functional.normalize(gaussians.quats)
    cosine = (got * wanted).sum(1).abs().double()
    assert torch.rad2deg(2 * torch.arccos(cosine.clamp(max=1))).max() < 0.2


@pytest.mark.parametrize("largest", [0.0, 0.99, 1.0, 3e6, 1e9])
def test_coordinates_of_any_size(file: Path, largest: float) -> None:
    gaussians = scene(4)
    with torch.no_grad():
        gaussians.means *= largest / gaussians.means.abs().max()
    write_spz(file, gaussians)
    got = read_spz(file).gaussians.means
    if largest == 1e9:  # beyond the format
        wanted = gaussians.means.clamp(-(2**23 - 1), 2**23 - 1)
        torch.testing.assert_close(got, wanted, atol=0.6, rtol=0)
    else:
        torch.testing.assert_close(got, gaussians.means, atol=max(largest * 2**-22, 2**-24), rtol=0)


def test_gaussians_beyond_the_format_are_counted(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gaussians = scene(9, degree=1)
    write_spz(file, gaussians)
    assert not caplog.messages
    with torch.no_grad():
        gaussians.sh0[:3] = torch.tensor([3.4, -3.4, 0.0])
        gaussians.sh0[3] = 3.3
        gaussians.scales[:2, 1] = 6.1
        gaussians.scales[2] = -torch.inf
        gaussians.shN[:4, 2, 0] = -1.1
        gaussians.means[8, 2] = 1e9
    write_spz(file, gaussians)
    counts = {"coordinates": 1, "colours": 3, "scales": 3, "harmonics": 4}
    for message, (name, count) in zip(caplog.messages, counts.items(), strict=True):
        assert f"a.spz: the {name} of {count} of 9 Gaussians are beyond what .spz holds" in message
    read = read_spz(file).gaussians
    torch.testing.assert_close(
        read.sh0[:3, 0], torch.tensor([[10 / 3, -10 / 3, 0]] * 3), atol=0.02, rtol=0
    )


@pytest.mark.parametrize("version", [3, 4])
def test_another_programs_files_are_read(version: int) -> None:
    read = read_spz(FILES / f"splat_transform_{version}.spz")
    assert read.antialiased
    wanted = load_ply(FILES / "source.ply")
    # That program has 12 fractional bits, and band 1 is rounded to 8 and then to 5 bits.
    assert_near(read.gaussians, wanted, 2**-13 + 1e-6, 1 / 32 + 1 / 256)


def test_a_file_that_does_not_name_its_axes_is_taken_as_it_is() -> None:
    """One of splat-transform up to 2.7.1 is so, and was turned about x: docs/export.md says it."""
    read = read_spz(FILES / "splat_transform_2.7.1.spz").gaussians
    wanted = load_ply(FILES / "source.ply")
    turned = transformed(wanted, np.diag([1.0, -1, -1, 1]))
    assert_near(read, turned, 2**-13 + 1e-6, 1 / 32 + 1e-6)
    assert (read.means - wanted.means).abs().max() > 4


def axes_named(data: bytes, number: int) -> bytes:
    """Name the axes of a .spz: at the end of version 3, before the streams of version 4."""
    record = struct.pack("<III", 0xADBE0003, 4, number)
    other = struct.pack("<IIf", 0xADBE0002, 4, 1.5)  # the limits of a camera
    if data[:2] == b"\x1f\x8b":
        content = bytearray(gzip.decompress(data))
        content[14] |= 2
        return gzip.compress(bytes(content) + other + record)
    (table,) = struct.unpack_from("<I", data, 16)
    head = bytearray(data[:table])
    head[14] |= 2
    struct.pack_into("<I", head, 16, table + 24)
    return bytes(head) + other + record + data[table:]


@pytest.mark.parametrize(("number", "version"), [(n, 3 + n % 2) for n in range(1, 17)])
def test_named_axes_are_turned_as_niantics_library_turns(
    file: Path, number: int, version: int
) -> None:
    """`axes.json` has what @adobe/spz 0.2.3 reads to right, down, forward of such files."""
    wanted = json.loads((FILES / "axes.json").read_text())[number - 1]
    file.write_bytes(axes_named((FILES / f"splat_transform_{version}.spz").read_bytes(), number))
    read = read_spz(file).gaussians
    np.testing.assert_allclose(read.means.detach(), wanted["means"], atol=1e-6)
    np.testing.assert_allclose(read.shN.detach(), wanted["shN"], atol=1e-6)
    other = Gaussians(**{name: read[name] for name in PARAMETERS})
    other.quats = torch.tensor(wanted["quats"])
    torch.testing.assert_close(covariances(read), covariances(other), atol=1e-6, rtol=1e-5)


def unpacked(file: Path) -> bytearray:
    return bytearray(gzip.decompress(file.read_bytes()))


def test_version_2_has_quaternions_of_three_bytes(file: Path) -> None:
    gaussians = scene(6, 1)
    write_spz(file, gaussians)
    content = unpacked(file)
    before, after = content[: 16 + 16 * 6], content[16 + 20 * 6 :]
    struct.pack_into("<I", before, 4, 2)
    unit = torch.nn.functional.normalize(gaussians.quats.detach()).numpy()
    xyz = unit[:, 1:] * np.where(unit[:, :1] < 0, -1, 1)
    quats = (xyz * 127.5 + 127.5).round().astype(np.uint8).tobytes()
    file.write_bytes(gzip.compress(bytes(before) + quats + bytes(after)))
    assert_near(read_spz(file).gaussians, gaussians, 1e-6, 0.5 / 128 + 1e-6)


def test_bands_above_3_and_extensions_are_left_out_with_a_word(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gaussians = scene(3, 3)
    write_spz(file, gaussians)
    content = unpacked(file)
    harmonics = np.frombuffer(content[16 + 20 * 3 :], np.uint8).reshape(3, 15, 3)
    wide = np.concatenate([harmonics, np.full((3, 9, 3), 7, np.uint8)], axis=1)
    content[12], content[14] = 4, 2
    extension = struct.pack("<II3s", 0x12345678, 3, b"any")
    file.write_bytes(gzip.compress(bytes(content[: 16 + 60]) + wide.tobytes() + extension))
    assert_near(read_spz(file).gaussians, gaussians, 1e-6, 0.5 / 128 + 1e-6)
    assert "bands of the harmonics above 3 are left out" in caplog.text
    assert "has the extension 0x12345678, which is not read" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c[:-1], "has 584 of its 585 bytes"),
        (lambda c: c[:10], "damaged"),
        (lambda c: b"NGSQ" + c[4:], "its header says"),
        (lambda c: c[:12] + b"\5" + c[13:], "degree 5"),
        (lambda c: c[:8] + b"\xff\xff\xff\xff" + c[12:], "4294967295 Gaussians do not fit"),
    ],
)
def test_damage_is_named(file: Path, change: object, message: str) -> None:
    with pytest.raises(XrgsError, match="cannot be read"):
        read_spz(file)
    assert callable(change)
    write_spz(file, scene())
    file.write_bytes(gzip.compress(change(bytes(unpacked(file)))))
    with pytest.raises(XrgsError, match=message) as error:
        read_spz(file)
    assert str(file) in str(error.value)


@pytest.mark.slow
def test_a_file_that_unpacks_to_far_more_is_refused(file: Path) -> None:
    count = 10**7
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 0, 12, 0, 0)
    packer = zlib.compressobj(9, wbits=31)
    parts = [packer.compress(header), *(packer.compress(bytes(count)) for _ in range(20))]
    file.write_bytes(b"".join([*parts, packer.flush()]))
    with pytest.raises(XrgsError, match="10000000 Gaussians do not fit"):
        read_spz(file)


def test_version_4_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(XrgsError, match=r"needs zstandard: pip install 'xrgs\[spz\]'"):
        read_spz(FILES / "splat_transform_4.spz")
