"""`examples/score_smaller.py` against scikit-image's averages."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from types import ModuleType

import numpy as np
import pytest
import torch
from skimage.measure import block_reduce
from skimage.metrics import peak_signal_noise_ratio

from tests import reference_store as reference
from xrgs import Gaussians, Store, rasterize, save_gaussians
from xrgs.evaluation.metrics import ssim
from xrgs.evaluation.protocol import mean_scores

FACTOR = 2


@pytest.mark.slow
def test_views_are_scored_at_both_sizes(
    script: Callable[[str], ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference.build(tmp_path)
    cell = Store(tmp_path).cell_folders()[0]
    data = cell.dataset()
    gaussians = Gaussians.from_points(data.points, data.colors)
    save_gaussians(cell.path / "splats.ply", gaussians)
    settings = cell.config().splat.raster
    expected: dict[str, list[float]] = {}
    for view in data.test:
        photograph, render = (
            block_reduce(image.detach().double().numpy(), (FACTOR, FACTOR, 1), np.mean)
            for image in (
                view.image,
                rasterize(gaussians, view.camera, settings=settings).image.clamp(0, 1),
            )
        )
        height, width = photograph.shape[:2]
        assert (height * FACTOR, width * FACTOR) == tuple(view.image.shape[:2])
        camera = view.camera.resized(width, height)
        small = rasterize(gaussians, camera, settings=settings).image.detach().clamp(0, 1)
        for kind, image in (("averaged", render), ("rendered", small.double().numpy())):
            psnr = peak_signal_noise_ratio(photograph, image, data_range=1)
            expected.setdefault(f"psnr {kind}", []).append(psnr)
            value = ssim(*(torch.from_numpy(of).float() for of in (image, photograph)))
            expected.setdefault(f"ssim {kind}", []).append(value or 0.0)
    full = mean_scores(gaussians, data.test, cell.config().splat)

    script("score_smaller").main([cell.id, "--store", str(tmp_path), "--factor", str(FACTOR)])

    header, line = capsys.readouterr().out.splitlines()
    words = header.split()
    columns = [" ".join(pair) for pair in zip(words[::2], words[1::2], strict=True)]
    name, *values = line.split()
    assert name == cell.id
    printed = dict(zip(columns, map(float, values), strict=True))
    assert printed.keys() == {*expected, "psnr full", "ssim full"}
    for column, of_views in expected.items():
        assert math.isclose(printed[column], fmean(of_views), abs_tol=1e-3)
    for metric in ("psnr", "ssim"):
        mean = full[metric]
        assert mean is not None
        assert math.isclose(printed[f"{metric} full"], mean, abs_tol=1e-4)
    assert printed["psnr averaged"] != printed["psnr full"]
