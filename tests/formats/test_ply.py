"""The .ply files of Gaussians against the plyfile library, and damaged ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import append_fields
from plyfile import PlyData, PlyElement

from xrgs.errors import XrgsError
from xrgs.formats.files import load_gaussians, save_gaussians
from xrgs.formats.ply import load_ply, read_ply, save_ply
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings
from xrgs.training.components.mip import smooth


def make(count: int = 5, degree: int = 3) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    rest = (degree + 1) ** 2 - 1
    shapes = ((3,), (4,), (3,), (), (1, 3), (rest, 3))
    tensors = (torch.randn(count, *shape, generator=g).requires_grad_() for shape in shapes)
    return Gaussians(*tensors)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "splats.ply"
    save_ply(path, make(), exact=True)
    return path


@pytest.mark.parametrize(("count", "degree"), [(0, 3), (1, 0), (7, 1), (7, 3)])
def test_what_was_saved_is_loaded(tmp_path: Path, count: int, degree: int) -> None:
    gaussians = make(count, degree)
    save_ply(tmp_path / "a.ply", gaussians, exact=True)
    loaded = load_ply(tmp_path / "a.ply")
    for name in PARAMETERS:
        assert torch.equal(loaded[name], gaussians[name])
        assert loaded[name].is_leaf
        assert loaded[name].requires_grad
        assert loaded[name].is_contiguous()


@pytest.mark.parametrize(
    ("suffix", "length"), [("ply", 1e-30), ("ply", 1.0), ("glb", 1e30), ("spz", 1e3)]
)
def test_quaternions_are_written_as_unit_ones(tmp_path: Path, suffix: str, length: float) -> None:
    gaussians = make(30)
    with torch.no_grad():
        gaussians.quats *= length
        gaussians.quats[4] = 0
        gaussians.shN.clamp_(-0.9, 0.9)
    save_gaussians(tmp_path / f"a.{suffix}", gaussians)
    read = load_gaussians(tmp_path / f"a.{suffix}").gaussians.quats.detach().double()
    torch.testing.assert_close(read.norm(dim=1), torch.ones(30).double(), rtol=0, atol=1e-6)
    wanted = make(30).quats.detach().double()
    wanted[4] = torch.tensor([1.0, 0, 0, 0])  # as it is rendered
    cosine = (read * wanted).sum(1).abs() / wanted.norm(dim=1) / read.norm(dim=1)
    assert cosine.min() > (1 - 1e-6 if suffix == "spz" else 1 - 1e-13)


@pytest.mark.parametrize(("suffix", "name"), [("glb", "quats"), ("spz", "scales"), ("spz", "shN")])
def test_no_writer_that_converts_hides_nan(tmp_path: Path, suffix: str, name: str) -> None:
    gaussians = make(4)
    gaussians[name].detach()[2] = math.nan
    with pytest.raises(XrgsError, match=r"of Gaussian 2 \(from 0\) is nan; it must be finite"):
        save_gaussians(tmp_path / f"a.{suffix}", gaussians)
    assert not any(tmp_path.iterdir())


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


def written(path: Path, table: np.ndarray[Any, Any], **options: Any) -> Path:
    PlyData([PlyElement.describe(table, "vertex")], **options).write(path)
    return path


@pytest.mark.parametrize(
    ("form", "kind"),
    [({"byte_order": "<"}, "f8"), ({"byte_order": ">"}, "f4"), ({"text": True}, "f4")],
)
def test_other_writers_orders_types_and_properties_are_read(
    tmp_path: Path, saved: Path, form: dict[str, Any], kind: str
) -> None:
    table = PlyData.read(saved)["vertex"].data
    names = [n for n in reversed(table.dtype.names) if not n.startswith("n")]
    columns = [("red", "u1"), *((n, kind) for n in names), ("semantic_id", "i4")]
    other = np.zeros(len(table), dtype=columns)
    for name in names:
        other[name] = table[name]
    loaded = load_ply(written(tmp_path / "b.ply", other, comments=["by another"], **form))
    for name in PARAMETERS:
        assert torch.equal(loaded[name], make()[name])


def changed(saved: Path, **columns: Any) -> Path:
    """Write values into the columns of a saved file, for Gaussian 3."""
    table = PlyData.read(saved)["vertex"].data.copy()
    for name, value in columns.items():
        table[name][3] = value
    return written(saved, table)


@pytest.mark.parametrize(
    ("name", "value"), [("opacity", np.inf), ("opacity", -np.inf), ("scale_2", -np.inf)]
)
def test_infinite_parameters_become_finite_ones_that_render_the_same(
    saved: Path, name: str, value: float
) -> None:
    gaussians = load_ply(changed(saved, **{name: value}))
    gaussians.means = torch.tensor([0.0, 0, 4]).repeat(5, 1)
    assert all(torch.isfinite(gaussians[each]).all() for each in PARAMETERS)
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 16], [0, 20, 16], [0, 0, 1]]), 32, 32)
    activated = gaussians.activated()
    exact = {"opacity": 1.0 if value > 0 else 0.0, "scale_2": 0.0}[name]
    scales, opacities = activated.scales.clone(), activated.opacities.clone()
    (opacities if name == "opacity" else scales[:, 2])[3] = exact
    parameters = activated._replace(scales=scales, opacities=opacities)
    got, wanted = (
        rasterize_parameters(*of, camera, RasterSettings(), sh_degree=3, backend="torch").image
        for of in (activated, parameters)
    )
    assert wanted.std() > 0.01
    torch.testing.assert_close(got, wanted, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("f_dc_1", np.nan), ("scale_0", np.inf), ("x", -np.inf), ("opacity", np.nan)],
)
def test_a_value_that_is_not_finite_is_named(saved: Path, name: str, value: float) -> None:
    message = rf"splats\.ply: {name} of Gaussian 3 \(from 0\) is {value}; it must be finite"
    with pytest.raises(XrgsError, match=message):
        load_ply(changed(saved, **{name: value}))


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ([], False),
        (["SplatRenderMode: mip"], True),
        (["Exported from Brush", " splatrendermode:MIP "], True),
        (["SplatRenderMode: 2dgs"], False),
        (["antialiased 1"], True),
        (["not antialiased 1"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
    ],
)
def test_the_tag_of_antialiased_gaussians(
    tmp_path: Path, saved: Path, comments: list[str], antialiased: bool
) -> None:
    table = PlyData.read(saved)["vertex"].data
    file = written(tmp_path / "a.ply", table, comments=[text.strip() for text in comments])
    assert read_ply(file).antialiased == antialiased


def test_an_own_tag_is_a_comment_that_is_read_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    save_ply(tmp_path / "a.ply", make(), antialiased=True)
    assert PlyData.read(tmp_path / "a.ply").comments == ["SplatRenderMode: mip"]
    assert read_ply(tmp_path / "a.ply").antialiased
    assert not caplog.text
    load_ply(tmp_path / "a.ply")
    assert "a.ply says that its Gaussians are antialiased: render them with" in caplog.text
    save_ply(tmp_path / "a.ply", make())
    assert PlyData.read(tmp_path / "a.ply").comments == []


def test_the_filter_of_mip_splatting_is_applied(
    tmp_path: Path, saved: Path, caplog: pytest.LogCaptureFixture
) -> None:
    table = append_fields(PlyData.read(saved)["vertex"].data, "filter_3D", np.full(5, 0.3, "f4"))
    read = read_ply(written(tmp_path / "a.ply", np.asarray(table)))
    assert read.antialiased
    assert "filter_3D" in caplog.text
    table["scale_1"][2] = 500
    with pytest.raises(XrgsError, match=r"of Gaussian 2 .* must be finite"):
        read_ply(written(tmp_path / "b.ply", np.asarray(table)))
    raw = load_ply(saved)
    scales, opacities = smooth(
        raw.scales.double().exp(),
        raw.opacities.double().sigmoid(),
        torch.full((5,), 0.3).double().square(),
    )
    torch.testing.assert_close(read.gaussians.scales.double().exp(), scales, atol=0, rtol=1e-5)
    torch.testing.assert_close(
        read.gaussians.opacities.double().sigmoid(), opacities, atol=1e-7, rtol=1e-5
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"plx\n", "is not a .ply file"),
        (b"float scale_2", b"float size_2", "the flat Gaussians of 2D Gaussian Splatting"),
        (b"float opacity", b"float opac", "a point cloud and no Gaussians: .*missing: opacity"),
        (b"float rot_1", b"float r", "ply: properties are missing: rot_1"),
        (b"float f_rest_44", b"float f_rest_x", "44 f_rest properties"),
        (b"float f_rest_44", b"float f_rest_99", "missing: f_rest_44"),
        (b"float x", b"float packed_position", "convert it: npx @playcanvas/splat-transform "
         ".*/splats.ply .*/splats-plain.ply"),
    ],
)  # fmt: skip
def test_what_is_no_file_of_gaussians_is_named(
    saved: Path, old: bytes, new: bytes, message: str
) -> None:
    saved.write_bytes(saved.read_bytes().replace(old, new, 1))
    with pytest.raises(XrgsError, match=message) as error:
        load_ply(saved)
    assert str(saved) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["a.KSPLAT", "meta.json"])
def test_other_formats_are_named_with_the_command_that_converts_them(name: str) -> None:
    command = f"npx @playcanvas/splat-transform {name} {Path(name).stem}.ply"
    with pytest.raises(XrgsError, match=f"format is not read; convert it: {command}"):
        load_ply(name)
