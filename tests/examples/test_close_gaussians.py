"""`examples/close_gaussians.py` on a cell into which Gaussians close to a camera are put."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from tests import reference_store as reference
from xrgs import Gaussians, Store, rasterize, save_gaussians
from xrgs.evaluation.protocol import mean_scores

COUNT = 4


def joined(first: Gaussians, second: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return Gaussians(*(torch.cat([first[name], second[name]]).detach() for name in names))


@pytest.mark.slow
def test_what_is_close_to_one_camera_is_counted_and_left_out(
    script: Callable[[str], ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference.build(tmp_path)
    cell = Store(tmp_path).cell_folders()[0]
    data = cell.dataset()
    views, camera = data.test, data.test[0].camera
    scene = Gaussians.from_points(data.points, data.colors)
    share = 0.1
    median = camera.to_camera(data.points)[2].median().item()
    rotation = camera.viewmat[:3, :3]
    ahead = camera.position + 0.5 * share * median * rotation[2]
    spread = 0.01 * median * torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(0))
    red = torch.tensor([[1.0, 0.0, 0.0]]).expand(COUNT, 3)
    close = Gaussians.from_points(ahead + spread, red, init_opacity=0.95)
    conf = cell.config().splat
    truth = [mean_scores(scene, [view], conf)["psnr"] for view in views]
    harmed = [mean_scores(joined(scene, close), [view], conf)["psnr"] for view in views]
    save_gaussians(cell.path / "splats.ply", joined(scene, close))
    png = tmp_path / "pair.png"

    script("close_gaussians").main(
        [cell.id, "--store", str(tmp_path), "--share", str(share), "--image", str(png)]
    )

    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split() == ["close", "psnr", "lpips", "psnr", "without", "lpips", "without"]
    rows = [line.split() for line in lines]
    assert [row[0] for row in rows] == [*(view.name for view in views), "mean"]
    assert int(rows[0][1]) == COUNT
    for row, bad, good in zip(rows, harmed, truth, strict=False):
        assert bad is not None
        assert good is not None
        assert math.isclose(float(row[2]), bad, abs_tol=0.001)
        assert math.isclose(float(row[4]), good, abs_tol=0.001)
    assert rows[0][2] != rows[0][4]
    gains = [float(row[4]) - float(row[2]) for row in rows[:-1]]
    best = views[gains.index(max(gains))].camera
    with Image.open(png) as image:
        left, right = np.split(np.asarray(image, dtype=np.float64), 2, axis=1)
    for half, shown in ((left, joined(scene, close)), (right, scene)):
        render = rasterize(shown, best, settings=conf.raster).image.detach().clamp(0, 1)
        assert np.abs(half - 255 * render.numpy()).max() < 0.51
