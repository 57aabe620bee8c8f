"""The rendering of the procedural scene; tests/training/dense finds its depths in the pictures."""

from __future__ import annotations

import math

import pytest
import torch

from xrgs.photos.scenes.still_life import Quad, pyramid, render

W, H, F = 80, 60, 70.0


@pytest.mark.parametrize("supersample", [1, 3])
def test_a_slanted_plane_is_seen_where_its_points_project(supersample: int) -> None:
    """Red is the texture coordinate a, green is b, so that a colour says which point is shown."""
    t = (torch.arange(64) + 0.5) / 64
    a, b = torch.meshgrid(t, t, indexing="xy")
    ramp = pyramid(torch.stack([a, b, torch.ones(64, 64)]))
    K = torch.tensor([[F, 0, W / 2 + 1.5], [0, F, H / 2 - 2.0], [0, 0, 1]])
    c, s = math.cos(math.radians(12)), math.sin(math.radians(12))
    viewmat = torch.tensor([[c, 0, s, 0.2], [0, 1, 0, -0.1], [-s, 0, c, 0.3], [0, 0, 0, 1.0]])
    quad = Quad("ramp", *torch.tensor([[-1.2, -0.9, 3.0], [2.0, 0.3, 1.5], [0.2, 1.8, -0.4]]))
    image = render([quad], {"ramp": ramp}, K, viewmat, W, H, supersample)
    ab = image[..., :2] / image[..., 2:]  # blue is the shade only
    inner = ((ab > 0.05) & (ab < 0.95)).all(-1) & (image[..., 2] > 0)
    assert inner.sum() > 600
    seen = quad.corner + ab[..., :1] * quad.u + ab[..., 1:] * quad.v
    x, y, depth = (K @ (viewmat[:3, :3] @ seen[inner].T + viewmat[:3, 3:])).unbind()
    rows, columns = inner.nonzero().T
    # A pixel of several samples sees their mean place, which perspective moves by < 0.01 px here.
    for place, number in ((x, columns), (y, rows)):
        assert (place / depth - number - 0.5).abs().max() < (2e-3 if supersample == 1 else 1e-2)
