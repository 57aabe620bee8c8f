"""Tests of `xrgs-bench` on a trained cell."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

RunCommand = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
def test_a_trained_cell_becomes_a_load_of_the_benchmark(
    call_command: RunCommand, swept: tuple[Path, str], tmp_path: Path
) -> None:
    cell = sorted((swept[0] / "s" / "cells").iterdir())[0]
    view = json.loads((cell / "status.json").read_text())["views"][0]
    save = ("--save", "a.npz", "--cell", str(cell), "--view")
    code, out, err = call_command("bench", *save, view)
    assert code == 0, err
    with np.load(tmp_path / "a.npz") as stored:
        count = json.loads((cell / "summary.json").read_text())["gaussians"]
        assert stored["means"].shape == (count, 3)
        assert stored["sh"].shape == (count, 16, 3)
        assert ((stored["opacities"] > 0) & (stored["opacities"] < 1)).all()
        with Image.open(cell / "renders" / f"{view}.png") as picture:
            assert picture.size == (stored["width"], stored["height"])
    assert f"{count} Gaussians" in out
    code, _, err = call_command("bench", *save, "none")
    assert code != 0
    assert "--view none: " in err
    assert view in err
