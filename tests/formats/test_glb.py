"""Gaussians as .glb against pygltflib, another program's file, and damaged files."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xrgs.errors import XrgsError
from xrgs.formats.glb import read_glb, write_glb
from xrgs.formats.ply import load_ply
from xrgs.formats.saved import transformed
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.sh import sh_to_colors

from .test_ply import make

FILES = Path(__file__).parent / "files"
EXTENSION = "KHR_gaussian_splatting"


def covariances(gaussians: Gaussians) -> torch.Tensor:
    scales = gaussians.scales.detach().double().exp()
    axes = rotation_matrices(gaussians.quats.detach().double()) * scales[:, None]
    return axes @ axes.transpose(1, 2)


def assert_same(got: Gaussians, wanted: Gaussians, tolerance: float) -> None:
    for name in PARAMETERS:
        if name not in {"quats", "scales"}:
            torch.testing.assert_close(got[name], wanted[name], atol=tolerance, rtol=0)
    torch.testing.assert_close(
        covariances(got), covariances(wanted), atol=tolerance, rtol=tolerance
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "a.glb"


@pytest.mark.parametrize(("degree", "antialiased"), [(0, True), (3, False)])
def test_what_was_written_is_read(file: Path, degree: int, antialiased: bool) -> None:
    gaussians = make(7, degree)
    write_glb(file, gaussians, antialiased=antialiased, up=(0.3, 0.5, -0.2))
    read = read_glb(file)
    assert read.antialiased == antialiased
    assert_same(read.gaussians, gaussians, 2e-6)
    write_glb(file, gaussians)  # half a turn about z, exactly
    assert torch.equal(read_glb(file).gaussians.means, gaussians.means)


@pytest.mark.parametrize(
    ("degree", "up"),
    [(3, (0, -1, 0)), (1, (0, 0, 2)), (2, (0.3, 0.5, -0.2)), (3, (0.3, 0.5, -0.2))],
)
def test_what_is_up_is_turned_in_the_gaussians_and_not_in_their_node(
    file: Path, degree: int, up: tuple[float, float, float]
) -> None:
    gaussians = make(7, degree)
    write_glb(file, gaussians, up=up)
    turns = []

    def change(description: Any, _: bytearray) -> None:
        (node,) = description["nodes"]
        assert node.keys() == {"mesh", "extras"}
        turns.append(Rotation.from_quat(node.pop("extras")["turned_by"]))

    read = read_glb(rewritten(file, change)).gaussians  # as another program's, to axes of .ply
    turn = Rotation.from_euler("z", 180, degrees=True) * turns[0]
    np.testing.assert_allclose(turn.apply(up) / np.linalg.norm(up), [0, -1, 0], atol=1e-12)
    matrix = torch.from_numpy(turn.as_matrix())
    torch.testing.assert_close(
        read.means.double(), gaussians.means.double() @ matrix.T, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        covariances(read), matrix @ covariances(gaussians) @ matrix.T, atol=1e-6, rtol=1e-5
    )
    dirs = torch.nn.functional.normalize(torch.randn(7, 3, dtype=torch.float64))
    before, after = (
        sh_to_colors(degree, at, of.sh0.double(), of.shN.double())
        for at, of in ((dirs, gaussians), (dirs @ matrix.T, read))
    )
    torch.testing.assert_close(after, before, atol=2e-6, rtol=0)


def test_a_file_of_version_0_2_0_has_a_turned_node_for_display(file: Path) -> None:
    gaussians = make(4)
    write_glb(file, gaussians)
    turn = Rotation.random(random_state=2).as_quat().tolist()

    def change(description: Any, _: bytearray) -> None:
        description["nodes"] = [
            {"mesh": 0, "rotation": turn, "extras": {"turned_for_display": True}}
        ]

    read = read_glb(rewritten(file, change)).gaussians
    assert_same(read, transformed(gaussians, np.diag([-1.0, -1, 1, 1])), 2e-6)


def test_opacities_of_0_and_1_flat_gaussians_and_zero_quaternions(file: Path) -> None:
    gaussians = make(3)
    with torch.no_grad():
        gaussians.opacities[:2] = torch.tensor([200.0, -200.0])
        gaussians.scales[0, 1] = -200.0
        gaussians.quats[2] = 0.0
    write_glb(file, gaussians)
    read = read_glb(file).gaussians
    assert read.opacities.sigmoid()[:2].tolist() == pytest.approx([1.0, 0.0], abs=1e-30)
    assert read.scales[0, 1] == -40
    assert read.quats[2].abs().tolist() == pytest.approx([1, 0, 0, 0])


def values(gltf: pygltflib.GLTF2, number: int) -> NDArray[Any]:
    """The values of an accessor, as pygltflib has its place."""
    accessor = gltf.accessors[number]
    view = gltf.bufferViews[accessor.bufferView]
    kind = {5126: "<f4", 5121: "u1"}[accessor.componentType]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
    content = gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(content, kind).reshape(accessor.count, width)


def test_pygltflib_reads_what_was_written(file: Path) -> None:
    gaussians = make(5)
    write_glb(file, gaussians, up=(0, 0, 2))
    gltf = pygltflib.GLTF2().load(str(file))
    assert gltf is not None
    assert gltf.extensionsUsed == [EXTENSION]
    (primitive,) = gltf.meshes[0].primitives
    assert primitive.mode == pygltflib.POINTS
    extension = primitive.extensions[EXTENSION]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    attributes = {name: at for name, at in vars(primitive.attributes).items() if at is not None}
    assert len(attributes) == 2 + 3 + 16
    read = {name: values(gltf, at) for name, at in attributes.items()}
    assert gltf.nodes[0].rotation is None
    turned = Rotation.from_quat(gltf.nodes[0].extras["turned_by"])
    np.testing.assert_allclose(turned.apply([0, 0, 1]), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(read["POSITION"], turned.apply(gaussians.means.detach()), atol=1e-6)
    bounds = gltf.accessors[attributes["POSITION"]]
    assert bounds.min == read["POSITION"].min(0).tolist()
    assert bounds.max == read["POSITION"].max(0).tolist()
    np.testing.assert_allclose(
        Rotation.from_quat(read[f"{EXTENSION}:ROTATION"]).as_matrix(),
        turned.as_matrix() @ rotation_matrices(gaussians.quats.detach().double()).numpy(),
        atol=1e-6,
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turned.as_matrix()
    gaussians = transformed(gaussians, matrix)
    np.testing.assert_allclose(
        read[f"{EXTENSION}:SCALE"], gaussians.scales.detach().exp(), rtol=1e-6
    )
    opacity = gaussians.opacities.detach().sigmoid()
    np.testing.assert_allclose(read[f"{EXTENSION}:OPACITY"][:, 0], opacity, atol=1e-7)
    sh = torch.cat([gaussians.sh0, gaussians.shN], dim=1).detach()
    for band in range(4):
        for of in range(2 * band + 1):
            name = f"{EXTENSION}:SH_DEGREE_{band}_COEF_{of}"
            np.testing.assert_allclose(read[name], sh[:, band * band + of], atol=1e-6)
    assert gltf.accessors[attributes["COLOR_0"]].normalized
    np.testing.assert_allclose(read["COLOR_0"][:, 3] / 255, opacity, atol=0.5 / 255 + 1e-6)


def test_another_programs_file_is_read() -> None:
    read = read_glb(FILES / "splat_transform.glb")
    assert not read.antialiased
    assert_same(read.gaussians, load_ply(FILES / "source.ply"), 2e-6)


def rewritten(file: Path, change: Callable[[Any, bytearray], None]) -> Path:
    """Change the JSON and the binary chunk of a .glb."""
    content = file.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    description = json.loads(content[20 : 20 + length])
    binary = bytearray(content[28 + length :])
    change(description, binary)
    text = json.dumps(description).encode()
    file.write_bytes(
        struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + bytes(binary)
    )
    return file


def test_nodes_above_and_values_of_8_bits(file: Path) -> None:
    gaussians = make(4)
    write_glb(file, gaussians)
    turn = Rotation.random(random_state=1)
    whole = np.array([0, 51, 128, 255], np.uint8)

    def change(description: Any, binary: bytearray) -> None:
        description["nodes"] = [
            {"mesh": 0, "translation": [1, 2, 3], "scale": [2, 2, 2]},
            {"children": [0], "rotation": turn.as_quat().tolist()},
        ]
        number = description["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:OPACITY"]
        description["accessors"][number] |= {"componentType": 5121, "normalized": True}
        description["bufferViews"][number] |= {"byteStride": 4, "byteOffset": len(binary)}
        for value in whole:
            binary += bytes([value, 9, 9, 9])

    read = read_glb(rewritten(file, change)).gaussians
    np.testing.assert_allclose(read.opacities.detach().sigmoid(), whole / 255, atol=1e-7)
    local, above = np.eye(4), np.eye(4)
    local[:3, :3] *= 2
    local[:3, 3] = 1, 2, 3
    above[:3, :3] = turn.as_matrix()
    gaussians.opacities = read.opacities
    half_turn = np.diag([-1.0, -1, 1, 1])
    wanted = transformed(gaussians, half_turn @ above @ local @ half_turn)
    assert_same(read, wanted, 5e-6)


def primitive(description: Any) -> Any:
    return description["meshes"][0]["primitives"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["nodes"].clear(), "has 0 models of KHR_gaussian_splatting"),
        (lambda d: d["nodes"].append({"mesh": 0}), "has 2 models"),
        (lambda d: primitive(d)["extensions"][EXTENSION].update(kernel="disc"), "kernel 'disc'"),
        (lambda d: primitive(d)["extensions"][EXTENSION].update(extensions={"KHR_spz": {}}),
         "KHR_spz is not read"),
        (lambda d: primitive(d)["attributes"].pop(f"{EXTENSION}:SCALE"), "too few .*:SCALE"),
        (lambda d: primitive(d)["attributes"].pop(f"{EXTENSION}:SH_DEGREE_1_COEF_2"),
         "too many attributes: .*SH_DEGREE_1_COEF_0"),
        (lambda d: primitive(d)["extensions"][EXTENSION].clear(), "KeyError: 'kernel'"),
        (lambda d: d.update(extensionsRequired=["EXT_meshopt"]), "EXT_meshopt is not read"),
        (lambda d: d["accessors"][0].update(sparse={}), "sparse"),
        (lambda d: d["accessors"][0].update(count=6), "reaches beyond|does not fit"),
        (lambda d: d["accessors"][0].update(count=10**15), "accessor 0 reaches beyond"),
        (lambda d: d["accessors"][1].update(count=4), "does not fit"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-1), "accessor 0 reaches beyond"),
        (lambda d: d["nodes"][0].update(extras={}, scale=[1, 2, 1]), "one scale for all axes"),
        (lambda d: d["nodes"][0].update(extras={}, children=[0], scale=[2, 2, 2]), ""),
        (lambda d: d.update(nodes=3), "is a damaged .glb"),
    ],
)  # fmt: skip
def test_what_is_not_served_or_damaged_is_named(
    file: Path, change: Callable[[Any], None], message: str
) -> None:
    write_glb(file, make())
    rewritten(file, lambda description, _: change(description))
    if not message:  # a circle ends
        read_glb(file)
        return
    with pytest.raises(XrgsError, match=message) as error:
        read_glb(file)
    assert str(file) in str(error.value)


def test_no_gaussians_and_infinite_scales_are_refused(file: Path) -> None:
    with pytest.raises(XrgsError, match="without Gaussians"):
        write_glb(file, make(0))
    gaussians = make()
    with torch.no_grad():
        gaussians.scales[2, 0] = 90.0
    with pytest.raises(XrgsError, match=r"SCALE of Gaussian 2 .* is inf"):
        write_glb(file, gaussians)
    assert not file.exists()
    with pytest.raises(XrgsError, match="cannot be read"):
        read_glb(file)
