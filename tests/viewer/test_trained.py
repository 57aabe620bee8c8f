"""Gaussians as the page of a report gets them."""

import numpy as np
import torch

from xrgs.splat.gaussians import Gaussians
from xrgs.viewer.trained import GAUSSIAN_BYTES, LOG_SCALES, quantise


def test_quantised_gaussians_are_close_to_the_original_ones() -> None:
    generator = torch.Generator().manual_seed(0)
    points = 0.25 * torch.randn(50, 3, generator=generator)
    colors = torch.rand(50, 3, generator=generator)
    gaussians = Gaussians.from_points(points, colors, init_opacity=0.7, generator=generator)
    with torch.no_grad():
        gaussians.scales += torch.randn(50, 3, generator=generator)
        gaussians.opacities += torch.randn(50, generator=generator)
        activated = gaussians.activated()
    kept = torch.arange(5, 25)
    content = quantise(activated, kept)
    assert len(content) == 20 * GAUSSIAN_BYTES
    bounded = np.frombuffer(content[: 20 * 6], "<u2").reshape(20, 3) / 65535 * 2 - 1
    means = bounded / (1 - np.abs(bounded))
    np.testing.assert_allclose(means, activated.means[kept].detach().numpy(), atol=2e-4)
    rest = np.frombuffer(content[20 * 6 :], "u1").reshape(20, 11) / 255
    scales = np.exp(LOG_SCALES[0] + rest[:, :3] * (LOG_SCALES[1] - LOG_SCALES[0]))
    np.testing.assert_allclose(scales, activated.scales[kept].numpy(), rtol=0.024)
    np.testing.assert_allclose(rest[:, 10], activated.opacities[kept].numpy(), atol=1 / 255)
