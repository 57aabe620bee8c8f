"""`examples/render_ply.py` renders what is in the .ply, from where it is told to."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from xrgs import Gaussians, save_ply

SCRIPT = Path(__file__).parents[2] / "examples" / "render_ply.py"
RED, BLUE = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]


@pytest.fixture(scope="session")
def render_ply(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("render_ply")


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    """Red Gaussians at x = -1, blue ones at x = 1."""
    spread = 0.2 * torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    side = torch.tensor([-1.0, 1.0]).repeat_interleave(10)
    points = spread + torch.stack([side, torch.zeros(20), torch.zeros(20)], dim=1)
    made = Gaussians.from_points(points, torch.tensor([RED] * 10 + [BLUE] * 10), init_opacity=0.9)
    save_ply(tmp_path / "splats.ply", made)
    return tmp_path / "splats.ply"


def halves(file: Path) -> list[NDArray[np.float64]]:
    """Mean colours of the left and the right half of an image of 60 x 40 px."""
    with Image.open(file) as image:
        pixels = np.asarray(image, dtype=np.float64)
    assert pixels.shape == (40, 60, 3)
    return [half.mean(axis=(0, 1)) for half in np.array_split(pixels, 2, axis=1)]


@pytest.mark.parametrize(("azimuth", "first"), [("0", "red"), ("180", "blue")])
def test_an_orbit_shows_both_sides(
    render_ply: ModuleType, ply: Path, tmp_path: Path, azimuth: str, first: str
) -> None:
    png = tmp_path / "image.png"
    size = ("--width", "60", "--height", "40")
    render_ply.main([str(ply), str(png), *size, "--azimuth", azimuth, "--target", "0", "0", "0"])
    left, right = halves(png)
    if first == "blue":
        left, right = right, left
    assert left[0] > 5
    assert left[0] > 10 * left[2]
    assert right[2] > 5
    assert right[2] > 10 * right[0]


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_any_axis_can_be_up(render_ply: ModuleType, ply: Path, tmp_path: Path, up: str) -> None:
    png = tmp_path / "image.png"
    render_ply.main([str(ply), str(png), "--width", "60", "--height", "40", "--up", up])
    assert max(half.max() for half in halves(png)) > 1


@pytest.mark.slow
def test_it_runs_as_a_script(ply: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(ply), str(tmp_path / "image.png"), "--width", "32"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "20 Gaussians, 32 x 480 px" in done.stdout
