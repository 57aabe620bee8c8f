"""`examples/train_with_gsplat.py`: its parts beside the definitions, and all of it on the CPU.

gsplat's renderer needs a GPU. On the CPU xrgs's, which has gsplat's signature, takes its place;
the strategy and everything else are those of the GPU.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from tests import reference_store as reference
from xrgs import Gaussians, Store
from xrgs.evaluation.protocol import score_file
from xrgs.formats.gsplat_api import rasterization


def test_ssim_is_kornias_over_the_windows_inside(script: Callable[[str], ModuleType]) -> None:
    from kornia.losses import SSIMLoss

    random = torch.Generator().manual_seed(0)
    first, second = torch.rand(2, 29, 41, 3, generator=random)
    second = 0.7 * first + 0.3 * second

    of_script = script("train_with_gsplat").ssim(first, second)

    batches = (image.permute(2, 0, 1)[None].double() for image in (first, second))
    loss = SSIMLoss(11, eps=0.0, padding="valid")(*batches)  # (1 - SSIM) / 2
    torch.testing.assert_close(of_script.double(), 1 - 2 * loss, rtol=0, atol=1e-6)


def test_splats_begin_on_the_points(script: Callable[[str], ModuleType]) -> None:
    random = torch.Generator().manual_seed(0)
    points, colors = torch.rand(2, 50, 3, generator=random)

    splats = script("train_with_gsplat").initial_splats(points, colors, "cpu")

    expected = Gaussians.from_points(points, colors)
    assert set(splats) == {"means", "quats", "scales", "opacities", "sh0", "shN"}
    for name in splats.keys() - {"quats"}:  # these are drawn at random
        of_script = splats[name].reshape(expected[name].shape)
        torch.testing.assert_close(of_script, expected[name], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_cell_is_saved_and_trained_on(
    script: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, scene = tmp_path / "store", tmp_path / "scene"
    reference.build(store)
    cell = Store(store).cell_folders()[0]
    data = cell.dataset()
    tests = [view for view in cell.variant().views if view.split == "test"]
    main = script("train_with_gsplat").main
    monkeypatch.setattr("gsplat.rasterization", rasterization)

    main(["save", cell.id, str(scene), "--store", str(store)])
    psnr = {}
    for steps in ("1", "90"):
        renders = tmp_path / steps
        main(["train", str(scene), str(renders), "--steps", steps, "--device", "cpu", "--resets"])
        record = json.loads((renders / "training.json").read_text())
        assert record["steps"] == int(steps)
        assert record["gaussians"] > 0
        scores = [score_file(renders / f"{v.name}.png", v, masked=False) for v in tests]
        psnr[steps] = fmean(score["psnr"] or 0.0 for score in scores)

    for view in data.train:
        with Image.open(scene / f"{view.name}.png") as image:
            assert np.array_equal(np.asarray(image), view.pixels)
    assert not any((scene / f"{view.name}.png").exists() for view in data.test)
    assert psnr["90"] > psnr["1"] + 2  # made-up photographs: dB of the mean colour
