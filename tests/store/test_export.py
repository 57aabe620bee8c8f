"""The masks of an exported variant, where other programs look for them."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree

from xrgs.errors import XrgsError
from xrgs.formats.gsplat_api import rasterization
from xrgs.mixture.colmap import read_points
from xrgs.mixture.saved_variant import freeze
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.splat.gaussians import Gaussians
from xrgs.store.export import export, without_invisible


def masked_variant(folder: Path) -> Variant:
    """Two training views, of which the first has a mask, and a test view."""
    made, variants = folder / "made", folder / "variants"
    (made / "images").mkdir(parents=True)
    variants.mkdir()
    used = np.zeros((15, 20), np.bool_)
    used[:, 5:] = True
    views = []
    for number, split in enumerate(("train", "train", "test")):
        file, mask = made / "images" / split / f"v{number}.png", None
        images.save(file, np.full((15, 20, 3), 0.5, np.float32))
        if number == 0:
            mask = made / "images" / f"{split}-masks" / f"v{number}.png"
            images.save_mask(mask, used)
        viewmat = np.eye(4)
        viewmat[:3, 3] = (0.1 * number, 0.2 * (number % 2), 0.05 * number)
        K = np.array([[20, 0, 10], [0, 20, 7.5], [0, 0, 1.0]])
        views.append(View(f"v{number}", file, split, "HR", 20, 15, K, viewmat, 1.0, mask))
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (20, 3))
    colors = np.zeros((20, 3), np.uint8)
    variant = Variant("", made, "x", 2, True, tuple(views), points, colors, {})
    return freeze(variant, "0" * 16, made, variants, {})


def test_each_image_has_a_mask_where_one_has(tmp_path: Path) -> None:
    variant = masked_variant(tmp_path)
    for layout in ("colmap", "nerfstudio"):
        out = tmp_path / layout
        export(variant.folder, layout, out)
        names = {file.name for file in (out / "images").iterdir()}
        assert {file.name for file in (out / "masks").iterdir()} == {f"{n}.png" for n in names}
        shares = {
            name: np.asarray(Image.open(out / "masks" / f"{name}.png")).mean() / 255
            for name in names
        }
        assert shares == {"train_v0.png": 0.75, "train_v1.png": 1.0, "test_v2.png": 1.0}
    frames = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())["frames"]
    assert len(frames) == 3
    for frame in frames:
        assert (tmp_path / "nerfstudio" / frame["mask_path"]).is_file()
        assert frame["mask_path"] == frame["file_path"].replace("images/", "masks/") + ".png"


def test_the_split_is_where_other_programs_look_for_it(tmp_path: Path) -> None:
    """3DGS reads sparse/0/test.txt; nerfbaselines 1.2.12 train_list.txt and test_list.txt in the
    folder; nerfstudio 1.1.5 asks for val_list.txt beside them, and fails without it."""
    out = tmp_path / "out"
    export(masked_variant(tmp_path).folder, "colmap", out)
    train, test = "train_v0.png\ntrain_v1.png\n", "test_v2.png\n"
    assert (out / "train_list.txt").read_text() == train
    assert (out / "val_list.txt").read_text() == test
    assert (out / "test_list.txt").read_text() == test
    assert (out / "sparse/0/test.txt").read_text() == test
    assert set((train + test).split()) == {file.name for file in (out / "images").iterdir()}


def test_an_export_that_is_stopped_leaves_nothing_in_the_way_of_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = masked_variant(tmp_path).folder, tmp_path / "out"
    full = OSError(errno.ENOSPC, "No space left on device", "transform.json")
    for stop, error in ((full, XrgsError), (KeyboardInterrupt(), KeyboardInterrupt)):
        with monkeypatch.context() as patch:
            patch.setattr("xrgs.store.export.transform", Mock(side_effect=stop))
            with pytest.raises(error):
                export(folder, "colmap", out)
        assert not out.exists()
    export(folder, "colmap", out)


def test_gaussians_that_no_render_shows_are_left_out() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(300, 3, generator=generator) * 2 + torch.tensor([-1.0, -1.0, 2.0])
    gaussians = Gaussians.from_points(points, torch.rand(300, 3, generator=generator))
    opacities = torch.logspace(-4, -0.1, 300)
    gaussians["opacities"] = opacities.logit()
    shown = without_invisible(gaussians, 1 / 255)
    assert len(shown) == (opacities >= 1 / 255).sum()
    K = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    before, after = (
        rasterization(
            some.means,
            some.quats,
            some.scales.exp(),
            some.opacities.sigmoid(),
            torch.cat([some.sh0, some.shN], 1),
            torch.eye(4)[None],
            K[None],
            40,
            30,
            sh_degree=3,
            rasterize_mode="antialiased",
        )[0]
        for some in (gaussians, shown)
    )
    torch.testing.assert_close(before, after, rtol=0, atol=1e-6)  # sums have another order


def test_the_transform_leads_from_the_world_of_given_poses(tmp_path: Path) -> None:
    """Points of the user's world, far from its origin, land on the exported points."""
    variant = masked_variant(tmp_path)
    world = np.eye(4)
    world[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    world[:3, 3] = (4_600_000.25, -500_000.5, 120)
    given = (variant.points - world[:3, 3]) @ world[:3, :3]
    moved = freeze_again(replace(variant, world=world), tmp_path)
    assert np.array_equal(moved.world, world)
    assert moved.id != variant.id
    export(moved.folder, "nerfstudio", tmp_path / "out")
    content = json.loads((tmp_path / "out" / "transform.json").read_text())
    matrix = np.array(content["sfm_to_export"])
    exported, _ = read_points(tmp_path / "out" / "points.ply")
    found = given @ matrix[:3, :3].T + matrix[:3, 3]
    # 64 bits round 5e6 to 1e-9; the .ply has its points in another order and in 32 bits.
    distances, nearest = cKDTree(exported).query(found)
    assert sorted(nearest) == list(range(len(found)))
    assert distances.max() < 1e-6 * np.abs(exported).max()


def freeze_again(variant: Variant, folder: Path) -> Variant:
    made = folder / "again"
    shutil.copytree(variant.folder, made)
    for name in ("variant.json", "points.npz", "report.json"):
        (made / name).unlink()
    views = [
        replace(
            view,
            file=made / view.file.relative_to(variant.folder),
            mask=view.mask and made / view.mask.relative_to(variant.folder),
        )
        for view in variant.views
    ]
    return freeze(replace(variant, views=tuple(views)), "1" * 16, made, folder / "variants", {})
