"""The solids of the procedural scene, and its rendering."""

from __future__ import annotations

import torch

from xrgs.photos.scenes import procedural, still_life
from xrgs.photos.scenes.raycast import pyramid, render


def test_every_pixel_shows_a_solid() -> None:
    width, height = procedural.camera_size(64)
    K = torch.from_numpy(procedural.intrinsics(width, height))
    white = {name: pyramid(torch.ones(3, 4, 4)) for name in procedural.TEXTURES}
    for pose in procedural.viewmats(24)[::3]:
        view = render(still_life.solids(), white, K, torch.from_numpy(pose), width, height, 1)
        assert view.min() > 0.5
