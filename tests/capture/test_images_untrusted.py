"""Damaged and hostile photographs: they are read, or refused by their name."""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from xrgs.capture import images
from xrgs.capture.images import ImageError

FAST = settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
#: A change of valid bytes: where (as a fraction), how many are replaced, and by what.
CHANGES = st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=12))


def changed(content: bytes, change: tuple[float, int, bytes]) -> bytes:
    fraction, count, new = change
    start = int(fraction * len(content))
    return content[:start] + new + content[start + count :]


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
def test_a_damaged_photograph_is_read_or_refused(tmp_path: Path, kind: str, change: Any) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(changed(PHOTOGRAPHS[kind], change))
    for reader in (images.size, images.exif_camera, images.read):
        try:
            reader(file)
        except ImageError as error:
            assert str(file) in str(error)  # noqa: PT017 - or it is read


def test_an_encapsulated_postscript_program_is_not_run(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    Image.new("RGB", (9, 9)).save(file, "EPS")
    with pytest.raises(ImageError, match=r"a\.png"):
        images.read(file)


def declared(width: int, height: int) -> bytes:
    """A PNG of one pixel whose header declares this size."""
    stream = io.BytesIO()
    Image.new("L", (1, 1)).save(stream, "PNG")
    content = stream.getvalue()
    size = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    head = b"IHDR" + size + content[24:29]
    return content[:12] + head + zlib.crc32(head).to_bytes(4, "big") + content[33:]


def test_an_image_that_declares_too_many_pixels_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(declared(1 << 20, 1 << 20))
    for reader in (images.size, images.read):
        with pytest.raises(ImageError, match=r"a\.png.*decompression bomb"):
            reader(tmp_path / "a.png")
