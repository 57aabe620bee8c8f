"""A scene that SfM can't place: tried once, and said in the words of a failed cell."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from xrgs.sweep.status import describe, read

TRIED = "building the mixed-resolution variant"
CONF = ("variant.factor=1", "variant.sfm.fallbacks=false")
HINT = "failed cells are left as they are: retry=failed runs them again"


def test_a_scene_that_failed_is_tried_again_when_asked_to(
    sweeps_in: Callable[..., Any], tmp_path: Path
) -> None:
    for number in range(2):  # flat: SIFT finds nothing
        pixels = np.full((30, 40, 3), 40 + number, np.uint8)
        (tmp_path / "leaves").mkdir(exist_ok=True)
        Image.fromarray(pixels).save(tmp_path / "leaves" / f"{number}.png")
    sweeps = sweeps_in(tmp_path)
    scene = ("scene=folder", "scene.path=leaves", "preset=smoke", *CONF)
    code, table, told = sweeps.run(*scene)
    assert code == 1
    assert TRIED in told
    assert "COLMAP placed 0 of 2 views" in table
    code, again, told = sweeps.run(*scene)
    assert code == 1
    assert again == table
    assert TRIED not in told
    assert "  failed     variant not built" in told
    assert "COLMAP placed 0 of 2 views" in told
    assert HINT in told
    text = describe(read(tmp_path / "s"))
    assert "failed scenes, left as they are: retry=failed tries them again" in text
    assert "  leaves  scene leaves failed: COLMAP placed 0 of 2 views" in text
    code, table, told = sweeps.run(*scene, "retry=failed", "fail_fast=true")
    assert code == 1
    assert TRIED in told
    assert HINT not in told
