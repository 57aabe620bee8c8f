"""`Camera.look_at`: where points of the world fall in its image."""

from __future__ import annotations

import math

import pytest
import torch

from xrgs.splat.cameras import Camera


def pixel(camera: Camera, point: tuple[float, float, float]) -> tuple[float, float, float]:
    """Column, row and depth of a point, by the definition of a pinhole camera."""
    x, y, z = (camera.viewmat @ torch.tensor([*point, 1.0]))[:3]
    u, v, w = camera.K @ torch.stack([x, y, z])
    return float(u / w), float(v / w), float(z)


def test_the_target_is_the_centre_of_the_image() -> None:
    camera = Camera.look_at((3.0, -1.0, 2.0), (0.5, 0.0, 1.0), width=80, height=60)
    distance = math.dist((3.0, -1.0, 2.0), (0.5, 0.0, 1.0))
    assert pixel(camera, (0.5, 0.0, 1.0)) == pytest.approx((40, 30, distance), rel=1e-5)
    assert camera.position.tolist() == pytest.approx([3.0, -1.0, 2.0], abs=1e-6)


def test_up_is_up_and_right_is_right() -> None:
    """Seen from the south, east is on the right and what is higher has a lower row."""
    camera = Camera.look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), width=80, height=60)
    assert pixel(camera, (1.0, 0.0, 0.0))[0] > 40
    assert pixel(camera, (0.0, 0.0, 1.0))[1] < 30


def test_the_field_of_view_reaches_the_borders() -> None:
    camera = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=80, height=60, fov=90)
    assert pixel(camera, (2.0, 0.0, 0.0))[0] == pytest.approx(80, rel=1e-5)


@pytest.mark.parametrize(
    ("position", "fov", "message"),
    [
        ((0.0, 0.0, 5.0), 50.0, "up must not be along the line"),
        ((0.0, 0.0, 0.0), 50.0, "up must not be along the line"),
        ((0.0, -5.0, 0.0), 180.0, "fov must be above 0 and below 180"),
    ],
)
def test_what_has_no_camera_is_refused(
    position: tuple[float, float, float], fov: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Camera.look_at(position, (0.0, 0.0, 0.0), width=8, height=6, fov=fov)
