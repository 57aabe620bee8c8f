"""The renderer that components get, for views other than the step's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tests.training.components.conftest import Build, renderer_of
from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings
from xrgs.training.components import Component, Components, Step
from xrgs.training.dataset import LoadedView


class Lowered(Component):
    """Lowers all opacities, so that a component that renders without it has other scores."""

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        return activated._replace(opacities=activated.opacities * 0.1)


def test_views_are_rendered_with_all_components(
    build: Build,
    off: ComponentsConf,
    lr: Step,
    shown: Gaussians,
    views: dict[str, LoadedView],
) -> None:
    off.supersampled.factor = off.supersampled.late_factor = 2
    fine = views["HR"], replace(views["LR"], sampling_rate=0.2)
    parts = Components([*build(off, *fine), Lowered()])
    renderer = renderer_of(parts)
    lower = shown.activated()._replace(opacities=shown.activated().opacities * 0.1)
    camera = parts.render_camera(lr.view.camera, lr)
    assert camera.width == 2 * lr.view.camera.width
    render = rasterize_parameters(*lower, camera, RasterSettings(), sh_degree=0)
    down = parts.to_photograph(render.image, lr)
    torch.testing.assert_close(renderer.photograph(shown, lr), down)
    # A Gaussian's weights are what its colour alone makes of the photograph.
    pixels = torch.rand(down.shape[:2], generator=torch.Generator().manual_seed(1)).double()
    sums = renderer.attribute(pixels, shown, lr)
    for index in range(len(shown)):
        sh0 = torch.full((8, 1, 3), -9.0).double()
        sh0[index] = 0.5 * np.sqrt(4 * np.pi)  # a colour of 1
        only = rasterize_parameters(
            *lower._replace(sh0=sh0), camera, RasterSettings(), sh_degree=0
        ).image
        expected = (parts.to_photograph(only, lr)[..., 0] * pixels).sum()
        torch.testing.assert_close(sums[index], expected)
    assert renderer.recorder.evaluations == 2 * render.evaluations
