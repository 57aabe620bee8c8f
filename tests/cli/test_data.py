"""Tests of `xrgs-data`: its commands, and what it refuses; downloads have their own tests."""

from __future__ import annotations

import json
import zlib  # noqa: F401  pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData
from scipy.spatial.transform import Rotation

import xrgs
import xrgs.store.inspect
from xrgs.mixture import poses, variant
from xrgs.safeio.atomic import write_json
from xrgs.store.cell_folder import CellFolder
from xrgs.sweep import job

XrgsData = Callable[..., tuple[int, str, str]]


def test_inspect_of_a_missing_scene_says_how_to_download_it(xrgs_data: XrgsData) -> None:
    code, _, err = xrgs_data("inspect", "scene=llff/fern", "data_root=none")
    assert code == 1
    assert "scene.path=none/fern: no such folder; to download what is missing:" in err
    assert "xrgs-data download llff fern --data-root none" in err


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The configs of the variants that were built; none is found, and none is really built."""
    confs: list[dict[str, Any]] = []

    def build(_: str, request: dict[str, Any], *__: object) -> dict[str, Any]:
        confs.append(request["conf"])
        return {"variant": "k-1"}

    monkeypatch.setattr(job, "run_in_child", build)
    monkeypatch.setattr(variant, "find", lambda *_: None)
    monkeypatch.setattr(xrgs.store.inspect, "describe", lambda folder, out: f"{folder} {out}")
    return confs


@pytest.mark.slow
def test_inspect_builds_a_variant_that_the_store_lacks(
    xrgs_data: XrgsData, monkeypatch: pytest.MonkeyPatch, built: list[dict[str, Any]]
) -> None:
    for jobs in (1, 1):  # the second time it is found
        code, out, err = xrgs_data("inspect", "scene=motorcycle", "store=s", "--out", "x.png")
        assert code == 0, err
        assert out.strip() == "s/variants/k-1 x.png"
        assert len(built) == jobs
        monkeypatch.setattr(variant, "find", lambda *_: SimpleNamespace(id="k-1"))


def test_inspect_takes_a_folder_of_photographs_as_they_are(
    xrgs_data: XrgsData,
    photographs: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    built: list[dict[str, Any]],
) -> None:
    photographs(tmp_path / "garden", 4)
    words = ("garden", "variant.long_side=99", "variant=distance", "store=s")
    code, out, err = xrgs_data("inspect", *words)
    assert code == 0, err
    assert out.endswith("s/variants/k-1 None\n")
    assert (tmp_path / "s/variants").is_dir()  # for the child that builds
    (conf,) = built
    assert (conf["scene"]["path"], conf["variant"]["long_side"]) == ("garden", 99)
    assert (conf["variant"]["tags"], conf["variant"]["factor"]) == ("distance", 1)
    code, _, err = xrgs_data("inspect", *words, "--out", "sheet.jpg")
    assert (code, len(built)) == (1, 1)
    assert err == "xrgs-data: --out sheet.jpg: the sheet is a PNG; name a file FILE.png"
    for word in ("variant.factor=2,4", "variant.factor=range(2,4)", "+ablation=plus,lean"):
        code, _, err = xrgs_data("inspect", "garden", word)
        assert (code, err) == (1, f"xrgs-data: {word}: give one value; xrgs-sweep takes several")
    code, _, err = xrgs_data("inspect", "graden")
    assert code == 1
    assert err == "xrgs-data: graden: there is no such folder, and no store xrgs-store"
    monkeypatch.setenv("HOME", "/home/me")
    for word in ("store=~/s", "--store=~/s"):
        _, _, err = xrgs_data("inspect", "graden", word)
        assert err == "xrgs-data: graden: there is no such folder, and no store /home/me/s"


def test_inspect_makes_images_again_of_a_trimmed_variant_and_tries_a_failed_scene_again(
    xrgs_data: XrgsData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built: list[Any]
) -> None:
    monkeypatch.setattr(variant, "key", lambda *_: "k")
    failed, trimmed = (tmp_path / "s" / "variants" / name for name in ("failed-k", "trimmed-k-1"))
    failed.mkdir(parents=True)
    write_json(failed / "report.json", {"scene": "motorcycle", "reason": "no first pair"})
    words = ("inspect", "scene=motorcycle", "store=s")
    assert (xrgs_data(*words)[0], len(built)) == (0, 1)
    trimmed.mkdir()
    requests: list[dict[str, Any]] = []
    monkeypatch.setattr(job, "run_in_child", lambda _, request, *__: requests.append(request))
    assert xrgs_data(*words)[:2] == (0, "s/variants/k-1 None\n")
    assert [request.get("variant") for request in requests] == ["k-1"]


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["colmap", "nerfstudio"])
def test_exported_splats_cameras_and_points_are_in_one_frame(
    xrgs_data: XrgsData, store: Path, tmp_path: Path, layout: str
) -> None:
    """The exported splats are rendered with the exported cameras, as other programs read them."""
    cell = sorted((store / "cells").iterdir())[0]
    out = tmp_path / "out"
    named = [str(cell)] if layout == "colmap" else [cell.name[:8], "--store", str(store)]
    code, said, err = xrgs_data("export", *named, "--format", layout, "--out", str(out))
    assert code == 0, err
    assert "2 training and 2 test views" in said
    cameras, points = (read_colmap if layout == "colmap" else read_transforms)(out)
    split = json.loads((out / "split.json").read_text())["images"]
    assert {entry["file"] for entry in split} == cameras.keys()
    assert {(entry["split"], entry["tag"]) for entry in split} == {
        *(("train", "HR"), ("train", "LR"), ("test", "HR"))
    }
    gaussians = xrgs.load_gaussians(out / "splats.ply").gaussians
    for entry in split:
        viewmat, K, size = cameras[entry["file"]]
        with Image.open(out / "images" / entry["file"]) as image:
            assert image.size == size
        if entry["split"] == "test":
            render = rendered(gaussians, viewmat, K, size)
            with Image.open(cell / "renders" / f"{entry['view']}.png") as stored:
                expected = torch.from_numpy(np.array(stored)) / 255.0
            errors = (render - expected).abs().amax(dim=-1) * 255
            # pycolmap stores quaternions. The last digits of a camera can move an alpha across
            # alpha_min, 1/255, in single pixels.
            assert (errors < 0.51).double().mean() > 0.999
            assert errors.max() < 1.51
            viewmat[0, 3] += 0.05  # an empty render would look the same from anywhere
            assert (rendered(gaussians, viewmat, K, size) - expected).abs().max() > 2 / 255
    variant = next((store / "variants").glob("*-*"))
    transform = np.array(json.loads((out / "transform.json").read_text())["sfm_to_export"])
    with np.load(variant / "points.npz") as arrays:
        moved = arrays["points"] @ transform[:3, :3].T + transform[:3, 3]
    moved, points = (array[np.lexsort(array.T)] for array in (moved, points))
    assert np.allclose(moved, points, atol=1e-5)
    named = [variant.name[:20], "--store", str(store)]  # without a cell there are no splats
    assert xrgs_data("export", *named, "--format", layout, "--out", "v")[0] == 0
    assert not (tmp_path / "v" / "splats.ply").exists()
    written = {"colmap": "sparse/0", "nerfstudio": "transforms.json"}[layout]
    poses.fingerprint(str(tmp_path / "v" / written))


def rendered(
    gaussians: xrgs.Gaussians, viewmat: torch.Tensor, K: torch.Tensor, size: tuple[int, int]
) -> torch.Tensor:
    camera = xrgs.Camera(viewmat.float(), K.float(), *size)
    return xrgs.rasterize(gaussians, camera).image.detach().clamp(0, 1)


Cameras = dict[str, tuple[torch.Tensor, torch.Tensor, tuple[int, int]]]


def read_colmap(out: Path) -> tuple[Cameras, NDArray[np.float64]]:
    """Viewmats, intrinsics and sizes by image, and the points, as pycolmap reads them."""
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    cameras = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3] = torch.from_numpy(image.cam_from_world().matrix())
        K = torch.from_numpy(camera.calibration_matrix())
        cameras[image.name] = viewmat, K, (camera.width, camera.height)
    tests = (out / "sparse" / "0" / "test.txt").read_text().splitlines()
    assert tests == sorted(name for name in cameras if name.startswith("test_"))
    return cameras, np.array([point.xyz for _, point in sorted(model.points3D.items())])


def read_transforms(out: Path) -> tuple[Cameras, NDArray[np.float64]]:
    """The same of transforms.json, by nerfstudio's convention of axes."""
    content = json.loads((out / "transforms.json").read_text())
    cameras = {}
    for frame in content["frames"]:
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        pose[:3, 1:3] *= -1
        K = torch.tensor(
            [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]
        )
        name = frame["file_path"].removeprefix("images/")
        cameras[name] = pose.inverse(), K, (frame["w"], frame["h"])
    assert content["train_filenames"] == [f"images/{name}" for name in cameras if "train" in name]
    assert content["test_filenames"] == [f"images/{name}" for name in cameras if "test" in name]
    vertices = PlyData.read(out / content["ply_file_path"])["vertex"]
    return cameras, np.stack([vertices[axis] for axis in "xyz"], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("form", "tolerance"), [("ply", 1e-6), ("glb", 1e-5), ("spz", 0.05)])
def test_the_splats_of_a_cell_render_the_same_from_every_format(
    xrgs_data: XrgsData, store: Path, tmp_path: Path, form: str, tolerance: float
) -> None:
    folder = sorted((store / "cells").iterdir())[0]
    code, said, err = xrgs_data("export", folder.name[:8], "--format", form, "--store", str(store))
    assert code == 0, err
    assert said.endswith(f"Gaussians: written to {folder.name}.{form}\n")
    cell = CellFolder(folder)
    gaussians, antialiased = xrgs.load_gaussians(tmp_path / f"{folder.name}.{form}")
    assert antialiased == cell.config().splat.raster.antialiased
    for view in cell.dataset().test:
        got, wanted = (
            xrgs.rasterize(of, view.camera, settings=cell.config().splat.raster).image.detach()
            for of in (gaussians, cell.gaussians())
        )
        assert wanted.std() > 0.005
        assert (got - wanted).abs().mean() <= tolerance * wanted.mean()
    if form == "glb":  # the cameras' mean up direction is glTF's +y
        description = (tmp_path / f"{folder.name}.glb").read_bytes()[20:].split(b'"turned_by":')[1]
        turn = Rotation.from_quat(json.loads(description.split(b"]")[0] + b"]"))
        ups = [-view.camera.viewmat[1, :3].numpy() for view in cell.dataset().train]
        up = np.mean(ups, axis=0)
        assert np.allclose(turn.apply(up / np.linalg.norm(up)), [0, 1, 0], atol=1e-6)


def test_files_of_gaussians_are_converted(xrgs_data: XrgsData, tmp_path: Path) -> None:
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    gaussians = xrgs.Gaussians.from_points(points, points)
    xrgs.save_gaussians(tmp_path / "a.b.ply", gaussians, antialiased=True)
    for _ in range(2):  # a file is replaced
        for source, form, made in (("a.b.ply", "glb", "a.b.glb"), ("./a.b.glb", "spz", "a.b.spz")):
            code, said, err = xrgs_data("export", source, "--format", form)
            assert code == 0, err
            assert said == f"9 antialiased Gaussians: written to {made}\n"
    for made in ("c.ply", "C.GLB", "new/one/d.spz"):  # the end of the name is the format
        code, said, err = xrgs_data("export", "a.b.ply", "--out", made)
        assert (code, said) == (0, f"9 antialiased Gaussians: written to {made}\n"), err
        assert len(xrgs.load_gaussians(tmp_path / made).gaussians) == 9
    read = xrgs.load_gaussians(tmp_path / "a.b.spz")
    assert read.antialiased
    assert torch.allclose(read.gaussians.means, gaussians.means, atol=1e-6)
    for arguments, message in (
        (["a.b.ply", "--format", "glb", "--out", "x"], "must end with .glb"),
        (["a.b.ply", "--format", "glb", "--out", "."], "--out .: "),
        (["a.b.ply", "--out", "x.obj"], "--out x.obj: a file ends with .ply, .glb, .spz"),
        (["a.b.ply", "--out", "x.ply", "--format", "colmap"], "--out x.ply: --format colmap"),
        (["a.b.ply", "--out", "a.b.ply/x.glb"], "a.b.ply: Not a directory"),
        (["none.ply", "--format", "glb"], "none.ply: cannot be read"),
        (["a.b.ply"], "a.b.ply: Not a directory; give the folder"),
    ):
        code, out, err = xrgs_data("export", *arguments)
        assert (code, out) == (1, "")
        assert message in err


def test_what_cant_be_exported_is_named(xrgs_data: XrgsData, tmp_path: Path) -> None:
    for folder in ("empty", "s/cells/cd", "s/variants/c1-ab", "s/variants/failed-c2"):
        (tmp_path / folder).mkdir(parents=True)
    for arguments, message in (
        (["gone"], "--store xrgs-store is not a store"),
        (["gone", "--store", "s"], "gone: no cells or variants have such an id"),
        (["c", "--store", "s"], "c: several cells or variants have such an id or scene: c1-ab, cd"),
        (["a.splat", "--store", "s"], "npx @playcanvas/splat-transform a.splat a.ply"),
        (["./gone"], "gone: No such file or directory; give the folder"),
        (["empty"], "empty: neither a cell nor a variant"),
    ):
        code, out, err = xrgs_data("export", *arguments)
        assert (code, out) == (1, "")
        assert message in err
