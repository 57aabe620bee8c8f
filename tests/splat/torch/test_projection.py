"""Culling against its closed form; tests/formats/test_gsplat_api.py has the projection's tests."""

from __future__ import annotations

import torch

from tests.splat.scenes import make_camera
from xrgs.splat.settings import RasterSettings
from xrgs.splat.torch.projection import project, visible_by_depth


def test_visible_is_the_bounding_box_against_the_image() -> None:
    camera = make_camera()
    settings = RasterSettings()
    generator = torch.Generator().manual_seed(0)
    count = 4000
    means = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 2
    means[:, 2] = 1 + means[:, 2].abs()
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    scales = 0.2 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    opacities = 0.02 * torch.rand(count, generator=generator, dtype=torch.float64)
    projected = project(means, quats, scales, opacities, camera, settings)
    visible = visible_by_depth(projected, camera, settings)
    assert (projected.depths[visible].diff() >= 0).all()
    expected = set()
    for i in range(count):
        opacity = float(projected.opacities[i])
        if opacity < settings.alpha_min:
            continue
        radius = (2 * torch.log(projected.opacities[i] / settings.alpha_min)).sqrt()
        x, y = projected.means2d[i]
        rx, ry = radius * projected.cov[i, 0].sqrt(), radius * projected.cov[i, 2].sqrt()
        if x + rx > 0 and x - rx < camera.width and y + ry > 0 and y - ry < camera.height:
            expected.add(i)
    assert set(visible.tolist()) == expected
    assert 100 < len(expected) < count - 100
