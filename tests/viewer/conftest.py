"""Small models to look at."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.settings import RasterSettings
from xrgs.viewer.models import Model, PosedView
from xrgs.viewer.paths import Poses


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """(name) -> from now on the package of that name is as if it were not installed."""
    real = builtins.__import__

    def hide(hidden: str) -> None:
        def imported(name: str, *others: Any) -> Any:
            if name == hidden:
                raise ImportError(name)
            return real(name, *others)

        monkeypatch.setattr(builtins, "__import__", imported)

    return hide


@pytest.fixture
def model() -> Callable[..., Model]:
    """(name, seed, settings) -> 40 Gaussians that four cameras look at, two test views of them."""

    def made(
        name: str = "baseline", seed: int = 0, settings: RasterSettings | None = None
    ) -> Model:
        generator = torch.Generator().manual_seed(seed)
        points = torch.randn(40, 3, generator=generator) * 0.3
        gaussians = Gaussians.from_points(
            points, torch.rand(40, 3, generator=generator), init_opacity=0.7, generator=generator
        )
        cameras = [
            Camera.look_at([np.sin(a), -2, 0.3], [0, 0, 0], width=49, height=36)
            for a in (-0.4, -0.1, 0.2, 0.4)
        ]
        kinds = ("HR", "LR", "test", "test")
        pairs = enumerate(zip(kinds, cameras, strict=True))
        views = tuple(PosedView(f"v{n}", kind, camera) for n, (kind, camera) in pairs)
        viewmats = np.stack([camera.viewmat.double().numpy() for camera in cameras])
        poses = Poses(viewmats[:2], viewmats[2:], points.double().numpy())
        return Model(name, gaussians, settings or RasterSettings(), views, poses, "variant-1")

    return made
