from __future__ import annotations

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


def test_the_position_has_camera_coordinates_of_zero() -> None:
    camera = make_camera(turned=True)
    seen = camera.viewmat[:3, :3] @ camera.position + camera.viewmat[:3, 3]
    torch.testing.assert_close(seen, torch.zeros(3, dtype=torch.float64), atol=1e-14, rtol=0)


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
        ("viewmat", torch.diag(torch.tensor([1.0, 1.0, 1.0, 2.0])), "the last row of viewmat"),
        ("viewmat", moved().T, r"the last row of viewmat .*\[0.0, 0.0, 3.0, 1.0\]; is it trans"),
        ("viewmat", moved().double().T, "the last row of viewmat"),
        ("K", torch.tensor([[40.0, 0, 0], [0, 40, 0], [24, 16, 1]]), "the last row of K"),
        ("K", torch.diag(torch.tensor([40.0, 40.0, 2.0])), "the last row of K"),
    ],
)
def test_bad_input_is_named(field: str, value: Any, message: str) -> None:
    good: dict[str, Any] = {"viewmat": torch.eye(4), "K": torch.eye(3), "width": 4, "height": 3}
    Camera(**good)
    with pytest.raises(ValueError, match=message):
        Camera(**(good | {field: value}))


def test_the_numbers_are_those_of_the_tensors() -> None:
    camera = Camera.look_at((1.0, 2.0, 3.0), (0.0, 0.5, 0.0), width=30, height=20)
    numbers = camera.numbers
    assert torch.equal(torch.tensor(numbers.viewmat).view(4, 4), camera.viewmat)
    assert torch.equal(torch.tensor(numbers.position), camera.position)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    assert numbers.intrinsics == [fx, fy, cx, cy]


def test_an_image_of_one_pixel_is_accepted() -> None:
    assert Camera(torch.eye(4), torch.eye(3), width=1, height=1).width == 1


def test_a_camera_of_another_size_projects_to_the_same_place_of_the_image() -> None:
    camera = Camera(torch.eye(4), torch.tensor([[90.0, 0, 31], [0, 80, 22], [0, 0, 1]]), 60, 48)
    resized = camera.resized(20, 96)
    assert (resized.width, resized.height) == (20, 96)
    points = torch.tensor([[0.3, -0.2, 2.0], [-0.1, 0.4, 1.5]])
    before, after = ((c.K @ points.T)[:2] / points.T[2] for c in (camera, resized))  # [2, P]
    torch.testing.assert_close(after, before * torch.tensor([[1 / 3], [2.0]]))
