"""Random loads, and loads from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from xrgs.bench import loads, run
from xrgs.bench.loads import Load
from xrgs.errors import XrgsError
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import project


def render(load: Load) -> torch.Tensor:
    return rasterize_parameters(*load.gaussians, load.camera, RasterSettings(), sh_degree=3).image


def rewritten(file: Path, **changes: object) -> Path:
    with np.load(file) as stored:
        arrays = {key: stored[key] for key in stored.files}
    kept = {key: value for key, value in (arrays | changes).items() if value is not None}
    np.savez(file, **kept)
    return file


def test_a_file_gives_back_what_was_written(load: Load, file: Path) -> None:
    again = loads.read(file)
    for value, written in zip(again.gaussians, load.gaussians, strict=True):
        assert torch.equal(value, written)
    assert torch.equal(again.camera.viewmat, load.camera.viewmat)
    assert torch.equal(again.camera.K, load.camera.K)
    assert (again.camera.width, again.camera.height) == (40, 30)
    assert again.name == "load"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("means", None, r".*\bmeans\b"),
        ("means", np.zeros((150, 2)), r"means must be \['N', 3\], got \[150, 2\]"),
        ("sh", np.zeros((150, 9, 3)), r"sh must be \['N', 16, 3\], got \[150, 9, 3\]"),
        ("width", np.array([40]), r"width must be \[\], got \[1\]"),
        ("width", np.array(10), "width and height must be at least 11, got 10x30"),
        ("means", np.full((150, 3), np.nan), "means must be finite"),
        ("scales", np.full((150, 3), -1.0), "scales must be at least 0"),
        ("means", np.full((150, 3), True), "means must be numbers"),
        ("means", np.full((150, 3), "x"), "cannot be read as .npz: means.npy: its header"),
        ("viewmat", 2 * np.eye(4), "viewmat must be a rotation"),
    ],
)
def test_wrong_values_are_named(file: Path, key: str, value: object, message: str) -> None:
    rewritten(file, **{key: value})
    with pytest.raises(XrgsError, match=rf"load\.npz: {message}"):
        loads.read(file)


def test_what_is_no_npz_is_refused(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match=r"none\.npz: cannot be read"):
        loads.read(tmp_path / "none.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    for content in (b"", b"PK\x03\x04 and no more", (tmp_path / "array.npy").read_bytes()):
        (tmp_path / "bad.npz").write_bytes(content)
        with pytest.raises(XrgsError, match=r"bad\.npz: cannot be read as \.npz"):
            loads.read(tmp_path / "bad.npz")


def test_a_crop_is_the_middle_of_the_view(load: Load) -> None:
    crop = load.center_crop(20, 10)
    whole, middle = render(load), render(crop)
    # The Jacobian's clamp follows the field of view, so that the two are not quite the same.
    assert (middle - whole[10:20, 10:30]).abs().mean() < 0.005
    assert (middle - whole[11:21, 11:31]).abs().mean() > 0.02
    same = load.center_crop(400, 400)
    assert (same.camera.width, same.camera.height) == (40, 30)


@pytest.mark.slow
def test_the_scene_is_as_heavy_as_a_trained_one() -> None:
    """56 Gaussians contribute to a pixel, counted with Eq. 8 and 14 in the middle rows."""
    scene = loads.random_load(*run.FULL.scene, 0, run.SCENE_SIZE_PER_SPACING)
    means, quats, scales, opacities, *_ = (value.double() for value in scene.gaussians)
    settings = RasterSettings()
    projected = project(means, quats, scales, opacities, scene.camera, settings)
    xx, xy, yy = projected.cov.unbind(-1)
    order = projected.depths.argsort()
    counts = []
    for x in range(8, scene.camera.width, 16):
        y = scene.camera.height // 2 + x % 7 - 3
        dx, dy = (torch.tensor([x + 0.5, y + 0.5]) - projected.means2d).unbind(-1)
        power = (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / (2 * projected.det)
        alpha = (projected.opacities * torch.exp(-power)).clamp_max(settings.alpha_max)[order]
        alpha = alpha[alpha >= settings.alpha_min]
        counts.append(int(((1 - alpha).cumprod(0) > settings.transmittance_min).sum()))
    assert 52 < sum(counts) / len(counts) < 60
