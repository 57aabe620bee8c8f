from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from xrgs.config import VariantConf
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views
from xrgs.photos.scenes import Scene

Photographs = Callable[..., PhotoCollection]


@pytest.fixture
def photographs(tmp_path: Path, configured: Callable[..., VariantConf]) -> Photographs:
    """(names, size, orientation) -> photographs; the names are paths without suffix."""

    def make(
        names: Sequence[str] = ("a", "b", "c"),
        size: tuple[int, int] = (102, 76),
        orientation: int | Mapping[str, int] = 1,
    ) -> PhotoCollection:
        files, exif = {}, Image.Exif()
        for name in names:
            exif[0x112] = orientation if isinstance(orientation, int) else orientation[name]
            pixels = np.random.default_rng(0).integers(0, 255, (*size[::-1], 3), dtype=np.uint8)
            file = tmp_path / "photographs" / f"{name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(file, exif=exif)
            files[name.replace("/", "_")] = file
        work = tmp_path / "work"
        work.mkdir()
        return prepare_hr_views(Scene("x", "", files), configured(long_side=0), work)

    return make


@pytest.fixture
def photos(photographs: Photographs) -> PhotoCollection:
    """Three photographs of 102 x 76 px, whose HR views are cropped to 100 x 75."""
    return photographs()
