"""Gaussians in .glb files: glTF 2.0 with the extension KHR_gaussian_splatting.

Scales and opacities are stored after the activation functions, quaternions as unit xyzw, and the
harmonics by coefficient, all as float32. glTF's y axis points up; that of .ply files points down.
So the Gaussians are rotated when written. Their node is not rotated, since programs differ in
whether a node rotates harmonics.

The extension has no flag for antialiased Gaussians, and sorts by distance from the camera, where 3D
Gaussian Splatting sorts by depth. Files that xrgs writes have in `extras` whether the Gaussians are
antialiased, and their rotation.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xrgs.errors import XrgsError
from xrgs.formats.saved import (
    CERTAIN_LOGIT,
    FLAT_LOG_SCALE,
    SavedGaussians,
    check_arrays_finite,
    to_gaussians,
)
from xrgs.formats.similarity import transformed
from xrgs.safeio.atomic import atomic_writer
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.normalize import rotation_between
from xrgs.splat.sh import C0, MAX_DEGREE, bases

Array = NDArray[Any]
Json = dict[str, Any]

EXTENSION = "KHR_gaussian_splatting"
_READ_EXTENSIONS = {EXTENSION, "KHR_mesh_quantization"}  # supported ones
_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_MAX_JSON = 1 << 24  # bytes
_POINTS = 0
_VERTEX_DATA = 34962  # the target of a bufferView
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5126: "f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
#: Half a turn about z, from y down as in .ply files to y up, as in SplatTransform.
_DOWN_TO_UP = np.diag([-1.0, -1.0, 1.0])
#: Key in `extras` of files by xrgs: the quaternion xyzw of the rotation from the Gaussians' world.
_TURNED_BY = "turned_by"
#: Key in files by xrgs up to 0.2.0: only the node is rotated, for display, not the Gaussians.
_DISPLAY = "turned_for_display"


def write_glb(
    path: Path,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    up: Sequence[float] = (0.0, -1.0, 0.0),
) -> None:
    """Write Gaussians, at least one, to a .glb file, which is replaced atomically.

    `up` is the direction [3] in their world that becomes glTF's +y, by rotating them.

    Raises:
        XrgsError: There are no Gaussians, a value is not finite, or the file would exceed 4 GiB.
    """
    if len(gaussians) == 0:
        raise XrgsError(f"{path}: glTF can't hold a model without Gaussians")
    start = np.asarray(up, np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = _DOWN_TO_UP @ rotation_between(
        start / np.linalg.norm(start), np.array([0.0, -1, 0])
    )
    attributes = _attributes(transformed(gaussians, matrix))
    check_arrays_finite(path, attributes)
    content = [np.ascontiguousarray(values).tobytes() for values in attributes.values()]
    description = _described(attributes, content, matrix[:3, :3], antialiased)
    text = json.dumps(description, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(map(len, content))
    total = 12 + 8 + len(text) + 8 + size
    if total >= 1 << 32:
        raise XrgsError(
            f"{path}: {len(gaussians)} Gaussians take {total} bytes, a .glb holds 4 GiB"
        )
    with atomic_writer(path) as file:
        file.write(struct.pack("<III", _MAGIC, _VERSION, total))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", size, _BINARY))
        file.writelines(content)


def _attributes(gaussians: Gaussians) -> dict[str, Array]:
    """Return attribute name -> array of the mesh, with unit quaternions."""
    means, quats, scales, opacities, sh0, shN = (
        gaussians[name].detach().double().numpy() for name in PARAMETERS
    )
    with np.errstate(over="ignore", invalid="ignore"):  # NaN is refused later
        alpha = 1 / (1 + np.exp(-opacities))
        linear = {"SCALE": np.exp(scales), "ROTATION": quats[:, [1, 2, 3, 0]], "OPACITY": alpha}
        attributes = {f"{EXTENSION}:{name}": values for name, values in linear.items()}
        sh = np.concatenate([sh0, shN], axis=1)  # [N, K, 3]
        for name, index in _harmonics(sh.shape[1]).items():
            attributes[name] = sh[:, index]
        floats = {name: values.astype("<f4") for name, values in attributes.items()}
        colors = _fallback_colors(sh0[:, 0], alpha)
    return {"POSITION": means.astype("<f4"), **floats, "COLOR_0": colors}


def _harmonics(count: int) -> dict[str, int]:
    """Return attribute name -> index of the coefficient."""
    names = [
        f"{EXTENSION}:SH_DEGREE_{band}_COEF_{order}"
        for band in range(math.isqrt(count))
        for order in range(2 * band + 1)
    ]
    return {name: index for index, name in enumerate(names)}


def _fallback_colors(sh0: Array, alpha: Array) -> Array:
    """Return linear colours and opacities [N, 4] uint8, for viewers that draw only points."""
    rgb = (C0 * sh0 + 0.5).clip(0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)  # from sRGB
    return np.asarray((np.column_stack([linear, alpha]) * 255).round().astype(np.uint8))


def _described(
    attributes: Mapping[str, Array], content: Sequence[bytes], turn: Array, antialiased: bool
) -> Json:
    """Return the JSON of a file with one mesh, whose arrays are contiguous in one buffer."""
    accessors: list[Json] = []
    views: list[Json] = []
    offset = 0
    for number, (name, values) in enumerate(attributes.items()):
        width = 1 if values.ndim == 1 else values.shape[1]
        is_float = values.dtype.kind == "f"
        accessor: Json = {
            "bufferView": number,
            "componentType": 5126 if is_float else 5121,
            "count": len(values),
            "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width],
        }
        if not is_float:
            accessor["normalized"] = True
        if name == "POSITION":  # its bounds are required
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        accessors.append(accessor)
        length = len(content[number])
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": length, "target": _VERTEX_DATA}
        )
        offset += length
    extension: Json = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
        "extras": {"antialiased": antialiased},
    }
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: extension},
    }
    quaternion = Rotation.from_matrix(turn).as_quat().tolist()  # xyzw
    return {
        "asset": {"version": "2.0", "generator": "xrgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "extras": {_TURNED_BY: quaternion}}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def read_glb(path: Path) -> SavedGaussians:
    """Read the Gaussians of a .glb file.

    The result has the axes of .ply files, y down: the transform of the Gaussians' node is applied,
    then half a turn about z. For files that xrgs has written, the result is in the Gaussians'
    original world.

    Raises:
        XrgsError: The file can't be read, is damaged, has no model of Gaussians or several, or
            an unsupported kind of Gaussians; the message names the file.
    """
    try:
        with path.open("rb") as file:
            content = file.read()
    except OSError as error:
        raise XrgsError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return _read(path, content)
    except (KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        # Missing or misplaced entries of the JSON raise any of these errors.
        raise XrgsError(f"{path}: is a damaged .glb ({type(error).__name__}: {error})") from error
    except ValueError as error:
        raise XrgsError(f"{path}: {error}") from error


def _read(path: Path, content: bytes) -> SavedGaussians:
    description, binary = _chunks(content)
    if needed := set(description.get("extensionsRequired", ())) - _READ_EXTENSIONS:
        raise ValueError(f"{', '.join(sorted(needed))} is not read")
    node, primitive = _model(description)
    extension = primitive["extensions"][EXTENSION]
    if "extensions" in extension:
        raise ValueError(f"{', '.join(extension['extensions'])} is not read")
    if extension["kernel"] != "ellipse" or extension["colorSpace"] != "srgb_rec709_display":
        raise ValueError(
            f"Gaussians of kernel {extension['kernel']!r} and colour space "
            f"{extension['colorSpace']!r} are not supported"
        )
    arrays = {
        name: _array(description, binary, number)
        for name, number in primitive["attributes"].items()
        if name == "POSITION" or name.startswith(f"{EXTENSION}:")
    }
    check_arrays_finite(path, arrays)
    gaussians = _gaussians(arrays)
    extras = description["nodes"][node].get("extras", {})
    if not extras.get(_DISPLAY):
        world = _to_world(description["nodes"], node)
        turn = _DOWN_TO_UP
        if _TURNED_BY in extras:
            turn = Rotation.from_quat(extras[_TURNED_BY]).as_matrix()
        world[:3] = turn.T @ world[:3]
        try:
            gaussians = transformed(gaussians, world)
        except ValueError as error:
            raise ValueError(f"the transform of its node {error}") from error
    return SavedGaussians(gaussians, bool(extension.get("extras", {}).get("antialiased")))


def _chunks(content: bytes) -> tuple[Json, bytes]:
    """Return the JSON and the buffer of a .glb."""
    if len(content) < 20 or struct.unpack_from("<II", content) != (_MAGIC, _VERSION):
        raise ValueError("is not a .glb file of version 2")
    length, kind = struct.unpack_from("<II", content, 12)
    if kind != _JSON or length > min(_MAX_JSON, len(content) - 20):
        raise ValueError("is cut off, or has no JSON of less than 16 MB at its start")
    description = json.loads(content[20 : 20 + length])
    binary = content[20 + length :]
    if len(binary) < 8:
        raise ValueError("has no binary chunk")
    size, kind = struct.unpack_from("<II", binary)
    if kind != _BINARY or size > len(binary) - 8:
        raise ValueError("is cut off: its binary chunk is not whole")
    return description, binary[8 : 8 + size]


def _model(description: Json) -> tuple[int, Json]:
    """Return the node and the primitive of the only model of Gaussians."""
    models = [
        (number, primitive)
        for number, node in enumerate(description.get("nodes", []))
        if "mesh" in node
        for primitive in description["meshes"][node["mesh"]]["primitives"]
        if EXTENSION in primitive.get("extensions", {})
    ]
    if len(models) != 1:
        raise ValueError(f"has {len(models)} models of {EXTENSION}; one is read")
    return models[0]


def _array(description: Json, binary: bytes, number: int) -> NDArray[np.float64]:
    """Return the values [N, width] of an accessor."""
    accessor = description["accessors"][number]
    if "sparse" in accessor:
        raise ValueError("sparse accessors are not read")
    view = description["bufferViews"][accessor["bufferView"]]
    kind = np.dtype(f"<{_COMPONENTS[accessor['componentType']]}")
    width, count = _WIDTHS[accessor["type"]], accessor["count"]
    stride = view.get("byteStride", width * kind.itemsize)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    end = start + stride * (count - 1) + width * kind.itemsize
    if view["buffer"] != 0 or min(start, count - 1, stride - 1) < 0 or end > len(binary):
        raise ValueError(f"accessor {number} reaches beyond the binary chunk")
    strides = (stride, kind.itemsize)
    stored = np.ndarray((count, width), kind, binary, offset=start, strides=strides)
    with np.errstate(invalid="ignore"):  # numpy warns of NaN of some bits
        values = stored.astype(np.float64)
    if accessor.get("normalized"):
        values = np.maximum(values / np.iinfo(kind).max, -1.0)
    return values


def _gaussians(arrays: Mapping[str, NDArray[np.float64]]) -> Gaussians:
    bands = [_harmonics(bases(degree)) for degree in range(MAX_DEGREE + 1)]
    names = max((band for band in bands if band.keys() <= arrays.keys()), key=len, default=bands[0])
    widths = {"POSITION": 3, **dict.fromkeys(names, 3)}
    widths |= {
        f"{EXTENSION}:{name}": width
        for name, width in (("ROTATION", 4), ("SCALE", 3), ("OPACITY", 1))
    }
    # A draft of the extension had other names, and an incomplete band would be ignored.
    if differing := sorted(widths.keys() ^ arrays.keys()):
        raise ValueError(f"has too few or too many attributes: {', '.join(differing)}")
    for name, width in widths.items():
        if arrays[name].shape != (len(arrays["POSITION"]), width):
            raise ValueError(f"{name} is {list(arrays[name].shape)}, which does not fit")
    sh = np.stack([arrays[name] for name in names], axis=1)  # [N, K, 3]
    alpha = arrays[f"{EXTENSION}:OPACITY"][:, 0]
    scales = arrays[f"{EXTENSION}:SCALE"]
    if ((alpha < 0) | (alpha > 1)).any() or (scales < 0).any():
        raise ValueError("has opacities outside 0..1, or scales below 0")
    with np.errstate(divide="ignore"):
        logits = np.log(alpha) - np.log1p(-alpha)
        logs = np.log(scales)
    values = {
        "means": arrays["POSITION"],
        "quats": arrays[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]],
        "scales": logs.clip(FLAT_LOG_SCALE),
        "opacities": logits.clip(-CERTAIN_LOGIT, CERTAIN_LOGIT),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    return to_gaussians(values)


def _to_world(nodes: Sequence[Json], node: int) -> NDArray[np.float64]:
    """Return the global transformation [4, 4] of a node."""
    parents = {child: i for i, parent in enumerate(nodes) for child in parent.get("children", [])}
    matrix, number = np.eye(4), node
    for _ in nodes:  # bounded, since a damaged file may have a cycle
        matrix = _local(nodes[number]) @ matrix
        if number not in parents:
            break
        number = parents[number]
    return matrix


def _local(node: Json) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column-major in the file
    matrix = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    matrix[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), np.float64)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix
