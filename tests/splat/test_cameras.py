"""Cameras: what they refuse, and where points of the world fall in their images."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from tests.splat.scenes import make_camera
from xrgs.splat.cameras import Camera


def moved() -> torch.Tensor:
    """A viewmat [4, 4] with a translation."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3
    return viewmat


def test_an_inverse_of_float32_is_a_viewmat() -> None:
    camera = make_camera(turned=True)
    viewmat = camera.viewmat.float()
    viewmat[:3, 3] = torch.tensor([300.0, -2000.0, 70.0])
    Camera(torch.linalg.inv(torch.linalg.inv(viewmat)), camera.K.float(), 9, 9)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 0, "width and height"),
        ("height", -1, "width and height"),
        ("viewmat", torch.eye(3), "viewmat must be"),
        ("K", torch.eye(4), "K must be"),
        ("viewmat", torch.full((4, 4), float("nan")), "viewmat has values"),
        ("K", torch.full((3, 3), float("inf")), "K has values"),
        ("K", torch.diag(torch.tensor([-1.0, 1.0, 1.0])), "focal lengths"),
        ("K", torch.tensor([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "skew"),
        ("viewmat", torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])), "without scale"),
        ("viewmat", torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])), "rotation"),
        ("viewmat", moved().T, r"the last row of viewmat .*\[0.0, 0.0, 3.0, 1.0\]; is it trans"),
        ("K", torch.tensor([[40.0, 0, 0], [0, 40, 0], [24, 16, 1]]), "the last row of K"),
        ("K", torch.diag(torch.tensor([40.0, 40.0, 2.0])), "the last row of K"),
    ],
)
def test_bad_input_is_named(field: str, value: Any, message: str) -> None:
    good: dict[str, Any] = {"viewmat": torch.eye(4), "K": torch.eye(3), "width": 1, "height": 1}
    Camera(**good)
    with pytest.raises(ValueError, match=message):
        Camera(**(good | {field: value}))


def test_a_camera_of_another_size_projects_to_the_same_place_of_the_image() -> None:
    camera = Camera(torch.eye(4), torch.tensor([[90.0, 0, 31], [0, 80, 22], [0, 0, 1]]), 60, 48)
    resized = camera.resized(20, 96)
    assert (resized.width, resized.height) == (20, 96)
    points = torch.tensor([[0.3, -0.2, 2.0], [-0.1, 0.4, 1.5]])
    before, after = ((c.K @ points.T)[:2] / points.T[2] for c in (camera, resized))  # [2, P]
    torch.testing.assert_close(after, before * torch.tensor([[1 / 3], [2.0]]))


# --- look_at ------------------------------------------------------------------------------------


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


def test_right_is_right_up_is_up_and_the_field_of_view_reaches_the_borders() -> None:
    """Seen from the south, east is on the right and what is higher has a lower row."""
    camera = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=80, height=60, fov=90)
    assert pixel(camera, (2.0, 0.0, 0.0))[0] == pytest.approx(80, rel=1e-5)
    assert pixel(camera, (0.0, 0.0, 1.0))[1] < 30


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
