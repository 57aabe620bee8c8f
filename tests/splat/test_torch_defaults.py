"""The package in a program that has changed torch's default type and device."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

#: `meta` stands for any device: an operation on it and on the CPU's memory raises.
PROGRAM = """
import sys, torch, xrgs
folder = sys.argv[1]
conf = xrgs.compose("scene=motorcycle", "preset=smoke", "train.steps=2", f"store={folder}/s")
torch.set_default_dtype(torch.float64)
torch.set_default_device("meta")
data = xrgs.build_dataset(conf)
gaussians = xrgs.train(data, conf).gaussians
image = xrgs.rasterize(gaussians, data.train[0].camera).image
assert (image.dtype, image.device.type) == (torch.float32, "cpu")
for suffix in (".ply", ".glb", ".spz"):
    xrgs.save_gaussians(f"{folder}/a{suffix}", gaussians)
    means = xrgs.load_gaussians(f"{folder}/a{suffix}").gaussians.means
    assert (means.dtype, means.device.type) == (torch.float32, "cpu")
try:
    xrgs.rasterize(gaussians, data.train[0].camera, sh_degree=9)
    raise SystemExit("sh_degree=9 is accepted")
except ValueError:
    pass  # and the program's own defaults are restored
assert torch.get_default_dtype() == torch.float64
assert torch.get_default_device().type == "meta"
"""


@pytest.mark.slow
def test_the_public_functions_work(tmp_path: Path, smoke_variants: Path) -> None:
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    run = [sys.executable, "-P", "-c", PROGRAM, str(tmp_path)]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
