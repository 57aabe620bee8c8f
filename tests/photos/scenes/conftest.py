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
    """(folder, *names, size) -> the scene of a folder with photographs of noise by these names."""

    def filled(folder: Path, *names: str, size: tuple[int, int] = (40, 30)) -> SceneConf:
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(len(names))
        for name in names:
            pixels = rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / name)
        return scene_conf("folder", folder)

    return filled
