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
