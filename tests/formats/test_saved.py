"""Gaussians in another world against renders by cameras that moved with them."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xrgs.formats.saved import transformed
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.rendering import rasterize

from .test_ply import make


def similarity(scale: float = 1.0, seed: int = 0, mirror: int = 1) -> NDArray[np.float64]:
    matrix: NDArray[np.float64] = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(random_state=seed).as_matrix() * [mirror, 1, 1]
    matrix[:3, 3] = [0.3, -2.0, 1.0]
    return matrix


def seen(gaussians: Gaussians, viewmat: torch.Tensor) -> torch.Tensor:
    K = torch.tensor([[30.0, 0, 20], [0, 30, 16], [0, 0, 1]], dtype=torch.float64)
    return rasterize(gaussians, Camera(viewmat, K, 40, 32)).image.detach()


@pytest.mark.parametrize(
    ("degree", "scale", "mirror"), [(0, 1.0, 1), (3, 0.25, 1), (2, 8.0, 1), (3, 2.0, -1)]
)
def test_cameras_that_move_as_well_see_the_same(degree: int, scale: float, mirror: int) -> None:
    gaussians = make(30, degree)
    viewmat = np.eye(4)
    viewmat[2, 3] = 6
    matrix = similarity(scale, degree, mirror)
    assert np.sign(np.linalg.det(matrix)) == mirror
    moved = viewmat @ np.linalg.inv(matrix)
    moved[:3] *= scale  # rigid again: depths are in units of the new world
    moved[0] *= mirror  # a camera has no mirror: it sees the image of a mirrored world turned round
    before = seen(gaussians, torch.from_numpy(viewmat))
    after = seen(transformed(gaussians, matrix), torch.from_numpy(moved))
    if mirror < 0:
        after = after.flip(1)
    assert before.std() > 0.05
    torch.testing.assert_close(after, before, atol=2e-5, rtol=0)


@pytest.mark.parametrize(
    ("linear", "message"),
    [
        (np.diag([1.0, 1, 0]), "a scale above 0"),
        (np.diag([1.0, 1, np.nan]), "a scale above 0"),
        (np.diag([1.0, 1, 1.01]), "one scale for all axes"),
        (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "without shear"),
    ],
)
def test_what_is_no_similarity_is_refused(linear: NDArray[np.float64], message: str) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    with pytest.raises(ValueError, match=re.escape(message)):
        transformed(make(3), matrix)
