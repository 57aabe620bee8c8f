"""What EXIF and XMP say of the camera, of crops and zooms, and of panoramas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from xrgs.mixture.photographs import assign_cameras
from xrgs.photos import exif, images
from xrgs.photos.images import ImageError

DETAILS = 0x8769
XMP = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {}</rdf:RDF></x:xmpmeta>'


def write(
    file: Path,
    details: dict[int, object] | None = None,
    *,
    size: tuple[int, int] = (40, 30),
    make: str = "Maker",
    xmp: str = "",
) -> Path:
    tags = Image.Exif()
    tags[0x010F], tags[0x0110] = make, "X 100"
    for tag, value in (details or {}).items():
        tags.get_ifd(DETAILS)[tag] = value
    more: dict[str, Any] = {}
    if xmp and file.suffix == ".png":
        more["pnginfo"] = PngInfo()
        more["pnginfo"].add_itxt("XML:com.adobe.xmp", XMP.format(xmp))
    elif xmp:
        content = XMP.format(xmp).encode()
        more = {"tiffinfo": {700: content}} if file.suffix == ".tif" else {"xmp": content}
    Image.new("RGB", size, (90, 120, 40)).save(file, exif=tags, **more)
    return file


def test_the_camera_is_read_from_exif(tmp_path: Path) -> None:
    Image.new("RGB", (20, 10)).save(tmp_path / "no_exif.jpg")
    assert exif.read(tmp_path / "no_exif.jpg") == exif.Taken()
    file = write(tmp_path / "exif.jpg", {0x920A: 23.0}, make="Maker ")
    assert exif.read(file).camera == "Maker/X 100/23.0"
    (tmp_path / "no.jpg").write_text("hello")
    with pytest.raises(ImageError, match=r"no\.jpg"):
        exif.read(tmp_path / "no.jpg")


@pytest.mark.parametrize(
    ("value", "expected"), [(28, 28.0), (0, None), (65535, None), ("28", 28.0), ("wide", None)]
)
def test_the_focal_length_on_film_is_read_where_it_is_one(
    tmp_path: Path, value: object, expected: float | None
) -> None:
    assert exif.read(write(tmp_path / "a.jpg", {0xA405: value})).focal_35mm == expected
    assert exif.read(write(tmp_path / "b.jpg")).focal_35mm is None


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize(
    ("details", "xmp"),
    [
        ({0xA404: 2.0}, ""),
        ({0xA002: 80, 0xA003: 30}, ""),
        ({}, 'crs:HasCrop="True" crs:CropTop="0.1" crs:CropLeft="0.2"/>'),
        ({}, "><crs:HasCrop>True</crs:HasCrop><crs:CropTop>0.1</crs:CropTop></rdf:Description>"),
    ],
    ids=["zoom", "aspect", "XMP attributes", "XMP elements"],
)
def test_a_crop_or_zoom_that_metadata_name_has_another_camera(
    tmp_path: Path, details: dict[int, object], xmp: str, suffix: str
) -> None:
    files = [write(tmp_path / f"a{suffix}"), write(tmp_path / f"b{suffix}", details, xmp=xmp)]
    first, second = assign_cameras(files, [images.size(file) for file in files], "auto")
    assert first != second
    assert exif.read(files[1]).cut


@pytest.mark.parametrize(
    "details",
    [
        {0xA404: 1.0},
        {0xA404: float("nan")},
        {0xA002: 30, 0xA003: 40},
        {0xA002: 4032, 0xA003: 3024},
        {0xA002: 0, 0xA003: 0},
    ],
)
def test_no_zoom_and_a_smaller_copy_are_no_crop(tmp_path: Path, details: dict[int, object]) -> None:
    assert exif.read(write(tmp_path / "a.jpg", details)).cut == ""


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_a_panorama_is_named_by_its_projection(tmp_path: Path, suffix: str) -> None:
    name = "cylindrical"
    file = write(tmp_path / f"a{suffix}", xmp=f'GPano:ProjectionType="{name}"/>')
    assert exif.read(file).projection == name
    inside = f"><GPano:ProjectionType>{name}</GPano:ProjectionType></rdf:Description>"
    assert exif.read(write(file, xmp=inside)).projection == name


def test_phones_name_their_panoramas_and_ordinary_photographs(tmp_path: Path) -> None:
    assert exif.read(write(tmp_path / "a.jpg", {0xA401: 6}, make="Apple")).projection
    assert not exif.read(write(tmp_path / "a.jpg", {0xA401: 2}, make="Apple")).projection
    assert not exif.read(write(tmp_path / "a.jpg", {0xA401: 6})).projection
    flat = write(tmp_path / "a.jpg", xmp='GPano:ProjectionType="perspective"/>')
    assert not exif.read(flat).projection
