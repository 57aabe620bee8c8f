"""The package in a program that has changed torch's default type and device."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import xrgs
from tests.conftest import composed


@pytest.fixture
def other_defaults() -> Iterator[None]:
    """`meta` stands for any device: an operation on it and on the CPU's memory raises."""
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    yield
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)


@pytest.mark.slow
def test_the_public_functions_work(
    tmp_path: Path, smoke_variants: Path, other_defaults: None
) -> None:
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    store = f"store={tmp_path}/s"
    conf = composed("scene=motorcycle", "preset=smoke", "train.steps=2", store)
    data = xrgs.build_dataset(conf)
    gaussians = xrgs.train(data, conf).gaussians
    image = xrgs.rasterize(gaussians, data.train[0].camera).image
    assert (image.dtype, image.device.type) == (torch.float32, "cpu")
    for suffix in (".ply", ".glb", ".spz"):
        xrgs.save_gaussians(tmp_path / f"a{suffix}", gaussians)
        means = xrgs.load_gaussians(tmp_path / f"a{suffix}").gaussians.means
        assert (means.dtype, means.device.type) == (torch.float32, "cpu")
    with pytest.raises(ValueError, match="sh_degree"):
        xrgs.rasterize(gaussians, data.train[0].camera, sh_degree=9)
    # The program's own defaults are restored, after an error too.
    assert torch.get_default_dtype() == torch.float64
    assert torch.get_default_device().type == "meta"
