"""Reads or writes a file of Gaussians with a program of PyPI, in an environment without xrgs.

`python programs.py read PROGRAM FILE OUT.json` writes the Gaussians that the program reads, as
arrays of N rows: `means`, `covariances` [6] or `quats` (wxyz) and `scales`, `opacities` (0..1),
`sh0` or `colors` (0..1), `shN` [K - 1, 3]. Arrays that the program does not offer are left out.
`python programs.py write PROGRAM FILE OUT` converts a .ply.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _logistic(values: Any) -> Any:
    return 1 / (1 + np.exp(-np.asarray(values, np.float64)))


def _gaussforge(file: Path) -> dict[str, Any]:
    from gaussforge import GaussForge

    read = GaussForge().read(file.read_bytes(), file.suffix[1:])
    if "error" in read:
        raise ValueError(read["error"])
    data, count = read["data"], read["data"]["numPoints"]
    arrays = {
        name: np.frombuffer(values, "<f4").reshape(count, -1)
        for name, values in data.items()
        if isinstance(values, bytes)
    }
    return {
        "means": arrays["positions"],
        "quats": arrays["rotations"],
        "scales": np.exp(arrays["scales"]),
        "opacities": _logistic(arrays["alphas"][:, 0]),
        "sh0": arrays["colors"],
        "shN": arrays["sh"].reshape(count, -1, 3),
    }


def _gsply(file: Path) -> dict[str, Any]:
    import gsply

    data = (gsply.read_spz if file.suffix == ".spz" else gsply.plyread)(str(file))
    return {
        "means": data.means,
        "quats": data.quats,
        "scales": np.exp(data.scales),
        "opacities": _logistic(data.opacities),
        "sh0": data.sh0,
        "shN": data.shN,
    }


def _aura_splat(file: Path) -> dict[str, Any]:
    if file.suffix == ".spz":
        from aura.spz import deserialize_spz

        data = deserialize_spz(file.read_bytes())
        return {
            "means": data["positions"],
            "quats": np.roll(data["rotations"], 1, axis=1),
            "scales": np.exp(data["scales"]),
            "opacities": _logistic(data["alphas"]),
            "sh0": data["colors"],
            "shN": data["sh"],
        }
    from aura.ingest.splats import load_3dgs_ply

    samples = load_3dgs_ply(file)
    return {
        "means": [sample.mean for sample in samples],
        "covariances": [[sample.covariance[i][k] for i, k in UPPER] for sample in samples],
        "opacities": [sample.opacity for sample in samples],
        "colors": [sample.color for sample in samples],
    }


def _fourdgs(file: Path) -> dict[str, Any]:
    from fourdgs import convert, gltf
    from fourdgs.quantization import SH_QUANT_HI, SH_QUANT_LO

    if file.suffix == ".glb":
        data = gltf.from_gltf(str(file)).gaussians
    else:
        with tempfile.TemporaryDirectory() as folder:  # fourdgs reads a sequence of .ply files
            shutil.copy(file, folder)
            data, _ = convert.convert_ply_sequence(folder)
    sh = data.sh / 255.0 * (SH_QUANT_HI - SH_QUANT_LO) + SH_QUANT_LO
    return {
        "means": data.positions,
        "quats": np.roll(data.rotations, 1, axis=1),
        "scales": data.scales,
        "opacities": data.colors[:, 3],
        "colors": data.colors[:, :3],
        "shN": sh.reshape(len(sh), 3, -1).swapaxes(1, 2),
    }


def _table(vertices: Any) -> dict[str, Any]:
    """Convert the vertices of a .ply in 3DGS's layout."""

    def columns(*names: str) -> Any:
        return np.stack([vertices[name] for name in names], axis=1)

    rest = columns(*(f"f_rest_{i}" for i in range(45)))
    return {
        "means": columns("x", "y", "z"),
        "quats": columns(*(f"rot_{i}" for i in range(4))),
        "scales": np.exp(columns(*(f"scale_{i}" for i in range(3)))),
        "opacities": _logistic(vertices["opacity"]),
        "sh0": columns(*(f"f_dc_{i}" for i in range(3))),
        "shN": rest.reshape(len(rest), 3, 15).swapaxes(1, 2),
    }


def _plyfile(file: Path) -> dict[str, Any]:
    from plyfile import PlyData

    return _table(PlyData.read(file)["vertex"].data)


def _trimesh(file: Path) -> dict[str, Any]:
    import trimesh

    if file.suffix == ".ply":
        cloud = trimesh.load(file)
        return _table(cloud.metadata["_ply_raw"]["vertex"]["data"]) | {"means": cloud.vertices}
    scene = trimesh.load_scene(file)
    (cloud,) = scene.dump()
    linear = np.asarray(cloud.colors, np.float64) / 255
    rgb = linear[:, :3]
    srgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    return {"means": cloud.vertices, "opacities": linear[:, 3], "colors": srgb}


def _pygltflib(file: Path) -> dict[str, Any]:
    from pygltflib import GLTF2

    gltf = GLTF2().load(file)
    (primitive,) = gltf.meshes[0].primitives

    def values(name: str) -> Any:
        accessor = gltf.accessors[getattr(primitive.attributes, name)]
        view = gltf.bufferViews[accessor.bufferView]
        content = gltf.binary_blob()[view.byteOffset :][: view.byteLength]
        return np.frombuffer(content, "<f4").reshape(accessor.count, -1)

    prefix = "KHR_gaussian_splatting:"
    bands = [
        f"{prefix}SH_DEGREE_{band}_COEF_{n}" for band in (1, 2, 3) for n in range(2 * band + 1)
    ]
    return {
        "means": values("POSITION"),
        "quats": np.roll(values(f"{prefix}ROTATION"), 1, axis=1),
        "scales": values(f"{prefix}SCALE"),
        "opacities": values(f"{prefix}OPACITY")[:, 0],
        "sh0": values(f"{prefix}SH_DEGREE_0_COEF_0"),
        "shN": np.stack([values(name) for name in bands], axis=1),
    }


READERS = {
    "gaussforge": _gaussforge,
    "gsply": _gsply,
    "aura-splat": _aura_splat,
    "fourdgs": _fourdgs,
    "plyfile": _plyfile,
    "trimesh": _trimesh,
    "pygltflib": _pygltflib,
}


def write(program: str, file: Path, out: Path) -> None:
    """Let a program convert a .ply."""
    if program == "gaussforge":
        from gaussforge import GaussForge

        converted = GaussForge().convert(file.read_bytes(), "ply", out.suffix[1:])
        if "error" in converted:
            raise ValueError(converted["error"])
        out.write_bytes(converted["data"])
    elif program == "gsply":
        import gsply

        data = gsply.plyread(str(file))
        (gsply.write_spz if out.suffix == ".spz" else gsply.plywrite)(str(out), data)
    elif program == "aura-splat":
        from aura.spz import serialize_spz

        data = _plyfile(file)
        cloud = {
            "positions": data["means"],
            "rotations": np.roll(data["quats"], -1, axis=1),
            "scales": np.log(data["scales"]),
            "alphas": np.log(data["opacities"] / (1 - data["opacities"])),
            "colors": data["sh0"],
            "sh": data["shN"],
            "sh_degree": 3,
        }
        out.write_bytes(serialize_spz(cloud))


def main() -> None:
    """Run `read` or `write` of the command line."""
    action, program, file, out = sys.argv[1], sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4])
    if action == "write":
        write(program, file, out)
        return
    read = READERS[program](file)
    out.write_text(
        json.dumps({name: np.asarray(array, np.float64).tolist() for name, array in read.items()})
    )


if __name__ == "__main__":
    main()
