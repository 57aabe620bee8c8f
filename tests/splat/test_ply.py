"""The .ply files of Gaussians against the plyfile library, and damaged ones."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.ply import load_ply, save_ply


def make(count: int = 5, degree: int = 3) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    rest = (degree + 1) ** 2 - 1
    shapes = ((3,), (4,), (3,), (), (1, 3), (rest, 3))
    tensors = (torch.randn(count, *shape, generator=g).requires_grad_() for shape in shapes)
    return Gaussians(*tensors)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "splats.ply"
    save_ply(path, make())
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_what_was_saved_is_loaded(tmp_path: Path, count: int, degree: int) -> None:
    gaussians = make(count, degree)
    save_ply(tmp_path / "a.ply", gaussians)
    loaded = load_ply(tmp_path / "a.ply")
    for name in PARAMETERS:
        assert torch.equal(loaded[name], gaussians[name])
        assert loaded[name].is_leaf
        assert loaded[name].requires_grad
        assert loaded[name].is_contiguous()


def test_layout_is_the_one_that_viewers_read(saved: Path) -> None:
    gaussians = make()
    data = PlyData.read(saved)
    vertex = data["vertex"]
    assert not data.text
    assert data.byte_order == "<"
    names = [p.name for p in vertex.properties]
    assert names == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(45)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    np.testing.assert_array_equal(vertex["y"], gaussians.means[:, 1].detach())
    np.testing.assert_array_equal(vertex["nx"], 0)
    np.testing.assert_array_equal(vertex["f_dc_2"], gaussians.sh0[:, 0, 2].detach())
    # All of red, then all of green, then all of blue.
    np.testing.assert_array_equal(vertex["f_rest_1"], gaussians.shN[:, 1, 0].detach())
    np.testing.assert_array_equal(vertex["f_rest_15"], gaussians.shN[:, 0, 1].detach())
    np.testing.assert_array_equal(vertex["f_rest_44"], gaussians.shN[:, 14, 2].detach())
    np.testing.assert_array_equal(vertex["opacity"], gaussians.opacities.detach())
    np.testing.assert_array_equal(vertex["scale_1"], gaussians.scales[:, 1].detach())
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats[:, 0].detach())


def test_another_writers_order_and_properties_are_read(tmp_path: Path, saved: Path) -> None:
    table = PlyData.read(saved)["vertex"].data
    names = [n for n in reversed(table.dtype.names) if not n.startswith("n")]
    other = np.zeros(len(table), dtype=[(n, "<f4") for n in [*names, "extra"]])
    for name in names:
        other[name] = table[name]
    element = PlyElement.describe(other, "vertex")
    PlyData([element], byte_order="<", comments=["by another"]).write(tmp_path / "b.ply")
    loaded, gaussians = load_ply(tmp_path / "b.ply"), make()
    for name in PARAMETERS:
        assert torch.equal(loaded[name], gaussians[name])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"plx\n", "is not a .ply file"),
        (b"binary_little_endian", b"binary_big_endian", "'format binary_big_endian 1.0'"),
        (b"binary_little_endian", b"ascii", "'format ascii 1.0'"),
        (b"vertex 5", b"vertex -5", "'element vertex -5'"),
        (b"vertex 5", b"vertex 6", "6 vertices of 62 floats need 1488 bytes, 1240 follow"),
        (b"vertex 5", b"vertex 4", "1240 follow"),
        (b"vertex 5", b"vertex 999999999999", "1240 follow"),
        (b"vertex 5", b"vertex " + b"9" * 40, "unexpected line"),
        (b"vertex 5", b"vertex five", "'element vertex five'"),
        (b"vertex 5", "vertex ٥".encode(), "unexpected line"),
        (b"element vertex 5", b"element face 5", "'element face 5'"),
        (b"property float nx", b"property double nx", "'property double nx'"),
        (b"property float nx", b"property list uchar int nx", "unexpected line"),
        (b"property float nx", b"element vertex 5", "'element vertex 5'"),
        (b"property float x", b"property float y", "names a property twice"),
        (b"property float opacity", b"property float opac", "missing: opacity"),
        (b"property float f_rest_44", b"property float g", "44 f_rest properties"),
        (b"property float f_rest_44", b"property float f_rest_x", "missing: f_rest_44"),
        (b"end_header\n", b"comment\n" * 600, "has no end"),
        (b"end_header\n", b"", "unexpected line"),
        (b"\n", b" ", "is not a .ply file"),
    ],
)
def test_a_bad_header_is_an_error_that_names_the_file(
    saved: Path, old: bytes, new: bytes, message: str
) -> None:
    saved.write_bytes(saved.read_bytes().replace(old, new, 1))
    with pytest.raises(XrgsError, match=re.escape(message)) as error:
        load_ply(saved)
    assert str(saved) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("change", [-1, -4, 1, 4])
def test_a_body_of_the_wrong_length(saved: Path, change: Any) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[:change] if change < 0 else data + b"\0" * change)
    with pytest.raises(XrgsError, match=f"{1240 + change} follow the header"):
        load_ply(saved)


def test_a_value_that_is_not_finite(saved: Path) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[:-4] + np.float32(np.nan).tobytes())
    with pytest.raises(XrgsError, match="not finite"):
        load_ply(saved)


@pytest.mark.parametrize("content", [b"", b"ply", b"ply\n", b"ply\n" + b"x" * 10_000])
def test_no_header(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.ply"
    path.write_bytes(content)
    with pytest.raises(XrgsError, match=r"c\.ply"):
        load_ply(path)


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(XrgsError, match="cannot be read"):
            load_ply(path)


@given(place=st.integers(0, 2400), junk=st.binary(min_size=1, max_size=12), cut=st.booleans())
@settings(
    max_examples=300,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_a_damaged_file_is_read_or_refused_and_nothing_else(
    tmp_path: Path, place: int, junk: bytes, cut: bool
) -> None:
    path = tmp_path / "d.ply"
    save_ply(path, make())
    data = path.read_bytes()
    path.write_bytes(data[:place] + junk + (b"" if cut else data[place + len(junk) :]))
    refused = None
    try:
        loaded = load_ply(path)
    except XrgsError as error:
        refused = str(error)
    if refused is None:
        assert all(torch.isfinite(loaded[name]).all() for name in PARAMETERS)
    else:
        assert str(path) in refused
