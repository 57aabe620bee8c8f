"""Folders of small photographs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.photos.scene_confs import scene_conf
from xrgs.config import SceneConf


@pytest.fixture
def fill() -> Callable[..., SceneConf]:
    """(folder, *names) -> the scene of a folder with photographs of noise by these names."""

    def filled(folder: Path, *names: str) -> SceneConf:
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(len(names))
        for name in names:
            pixels = rng.integers(0, 255, (30, 40, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / name)
        return scene_conf("folder", folder)

    return filled
