"""Scores of a cell, from the scores of its views."""

import math

import numpy as np
import pandas as pd
import pytest
import torch

from xrgs.evaluation.metrics import psnr
from xrgs.store.results import over_views


def test_pooled_psnr_is_that_of_all_pixels_together() -> None:
    rng = torch.Generator().manual_seed(0)
    photographs = torch.rand(3, 8, 9, 3, generator=rng)
    noise = torch.rand(photographs.shape, generator=rng) - 0.5
    renders = photographs + noise * torch.tensor([0.1, 0.01, 0.6])[:, None, None, None]
    pairs = zip(renders, photographs, strict=True)
    views = pd.DataFrame({"cell_id": "a", "psnr": [psnr(*pair) for pair in pairs]})
    found = over_views(views).loc["a"]
    together = psnr(renders.reshape(24, 9, 3), photographs.reshape(24, 9, 3))
    assert found["psnr_pooled"] == pytest.approx(together, rel=1e-12)
    assert found["psnr_worst"] == views["psnr"].min()
    assert found["psnr"] == pytest.approx(views["psnr"].mean())
    assert found["psnr_worst"] < found["psnr_pooled"] < found["psnr"], "as Jensen has it"


def test_cells_are_apart_and_a_score_that_a_view_lacks_is_missing() -> None:
    views = pd.DataFrame(
        {
            "cell_id": ["a", "a", "b", "b"],
            "psnr": [20.0, 20.0, 10.0, math.nan],
            "lpips": [0.1, math.nan, 0.2, 0.4],
        }
    )
    found = over_views(views)[["psnr", "psnr_pooled", "psnr_worst", "lpips"]].to_numpy()
    nan = math.nan
    assert found[0] == pytest.approx([20, 20, 20, nan], nan_ok=True)
    assert found[1] == pytest.approx([nan, nan, nan, 0.3], nan_ok=True)


def test_views_without_any_error_have_infinite_psnr() -> None:
    found = over_views(pd.DataFrame({"cell_id": ["a", "a"], "psnr": [math.inf, math.inf]}))
    assert np.array_equal(found.to_numpy(), [[math.inf] * 3])
