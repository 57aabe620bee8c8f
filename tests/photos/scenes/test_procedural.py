"""The cameras of the procedural scene."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from xrgs.photos.scenes import procedural


@pytest.fixture(scope="module")
def poses() -> NDArray[np.float64]:
    return procedural.viewmats(24)


def test_the_embedded_scenes_cameras_are_rigid_and_face_forward(poses: NDArray[np.float64]) -> None:
    rotation = poses[:, :3, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(np.ones(24))
    assert (rotation[:, 2, 2] > 0.9).all()


def test_held_out_views_are_spread_among_the_others(poses: NDArray[np.float64]) -> None:
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    train = np.delete(centres, [0, 8, 16], axis=0)
    for test in centres[[0, 8, 16]]:
        assert (train.min(0)[:2] < test[:2]).all()
        assert (test[:2] < train.max(0)[:2]).all()
