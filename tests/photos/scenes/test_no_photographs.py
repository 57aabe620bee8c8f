"""Panoramas by their metadata and by what they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from xrgs.errors import XrgsError
from xrgs.photos.scenes import folder

XMP = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="cylindrical"/></x:xmpmeta>'


def texture(seed: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """A smooth random picture [H, W, 3]."""
    noise = np.random.default_rng(seed).random((size[1], size[0], 3))
    smooth = gaussian_filter(noise, (size[1] / 20, size[1] / 20, 0))
    low, high = smooth.min(), smooth.max()
    picture: NDArray[np.uint8] = ((smooth - low) / (high - low) * 255).astype(np.uint8)
    return picture


def sphere(seed: int, height: int = 128) -> NDArray[np.uint8]:
    """Random bumps in all directions, around and from above to below [H, 2 H, 3]."""
    rng = np.random.default_rng(seed)
    up = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    around = (np.arange(2 * height) + 0.5) / height * np.pi
    lat, lon = np.meshgrid(up, around, indexing="ij")
    rays = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
    centres = rng.normal(size=(60, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    bumps = np.exp(20 * (rays @ centres.T - 1)) @ rng.random((60, 3))
    picture: NDArray[np.uint8] = (bumps / bumps.max() * 255).astype(np.uint8)
    return picture


def test_pictures_of_all_directions_are_left_out_without_metadata(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(texture(i, (160, 120))).save(tmp_path / f"a{i}.jpg")
        Image.fromarray(sphere(i)).save(tmp_path / f"p{i}.jpg")
    found = folder.look(str(tmp_path), 0)
    assert [*found.files] == ["a0", "a1", "a2"]
    (note,) = found.notes
    assert note == (
        "left out as panoramas of 360 degrees, by their shape and edges: p0.jpg, p1.jpg, p2.jpg"
    )


def changed(kind: str, seed: int) -> NDArray[np.uint8]:
    """A panorama of all directions, as its maker left it."""
    picture = sphere(seed)
    if kind == "sky":
        picture[:64] = np.linspace(220, 160, 64)[:, None, None]
    elif kind == "black from below":
        picture[-16:] = 0
    elif kind == "tripod":
        picture[-12:, 50:120] = 255
    elif kind == "strip":
        picture = picture[16:-16]
    return picture


@pytest.mark.parametrize("kind", ["sky", "black from below"])
def test_a_plain_sky_or_floor_of_a_panorama_hides_it_not(tmp_path: Path, kind: str) -> None:
    for i in range(3):
        Image.fromarray(changed(kind, i)).save(tmp_path / f"p{i}.png")
    with pytest.raises(XrgsError, match="left out as panoramas of 360 degrees"):
        folder.look(str(tmp_path), 0)


@pytest.mark.parametrize("kind", ["tripod", "strip"])
def test_what_may_be_a_panorama_is_kept_and_named(tmp_path: Path, kind: str) -> None:
    for i in range(3):
        Image.fromarray(changed(kind, i)).save(tmp_path / f"p{i}.png")
    found = folder.look(str(tmp_path), 0)
    assert [*found.files] == ["p0", "p1", "p2"]
    (note,) = found.notes
    assert note == (
        "kept, and perhaps panoramas, since their left edges go on at the right: "
        "p0.png, p1.png, p2.png"
    )


@pytest.mark.parametrize("background", ["gradient", "noise"])
def test_objects_before_a_plain_background_are_kept(tmp_path: Path, background: str) -> None:
    """It goes on at the other side, and its top and bottom rows vary little."""
    rows = np.linspace(250, 120, 100) if background == "gradient" else np.full(100, 240.0)
    for i in range(8):
        picture = np.repeat(np.repeat(rows[:, None, None], 200, axis=1), 3, axis=2)
        if background == "noise":
            picture = picture + np.random.default_rng(i).normal(0, 2, picture.shape)
        picture[30:70, 20 + 10 * i : 100 + 10 * i] = texture(i, (80, 40))
        Image.fromarray(picture.astype(np.uint8)).save(tmp_path / f"a{i}.png")
    assert len(folder.look(str(tmp_path), 0).files) == 8


def test_a_panorama_of_part_of_the_view_is_left_out_by_its_metadata(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(texture(i, (160, 120))).save(tmp_path / f"a{i}.jpg")
    Image.fromarray(texture(9, (160, 120))).save(tmp_path / "p.jpg", xmp=XMP)
    found = folder.look(str(tmp_path), 0)
    assert [*found.files] == ["a0", "a1", "a2"]
    assert found.notes == ("left out as panoramas, by their metadata (cylindrical): p.jpg",)
