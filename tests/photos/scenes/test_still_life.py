"""The solids of the procedural scene, and its rendering."""

from __future__ import annotations

from pathlib import Path

import torch

from tests.photos.scene_confs import scene_conf
from xrgs.photos import scenes
from xrgs.photos.scenes import procedural, still_life
from xrgs.photos.scenes.raycast import pyramid, render


def test_every_pixel_shows_a_solid() -> None:
    width, height = procedural.camera_size(64)
    K = torch.from_numpy(procedural.intrinsics(width, height))
    white = {name: pyramid(torch.ones(3, 4, 4)) for name in procedural.TEXTURES}
    for pose in procedural.viewmats(24)[::3]:
        view = render(still_life.solids(), white, K, torch.from_numpy(pose), width, height, 1)
        assert view.min() > 0.5


def test_the_same_scene_is_rendered_to_the_same_bytes(tmp_path: Path) -> None:
    conf = scene_conf("procedural", name="procedural", views=3)
    a = scenes.resolve(conf, tmp_path / "a", 60)
    b = scenes.resolve(conf, tmp_path / "b", 60)
    assert [f.read_bytes() for f in a.files.values()] == [f.read_bytes() for f in b.files.values()]
