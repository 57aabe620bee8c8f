"""Section 7.2: LR views have the more weight, the less texture the scene has."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Components, Step, TrainingView
from xrgs.training.components.texture import gradient_magnitude

#: The losses of these tests do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)

MakeView = Callable[[str, Tensor], TrainingView]


def ramp(slope: float) -> Tensor:
    """An image [12, 15, 3] whose gradient has the magnitude `slope` everywhere."""
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(15.0), indexing="ij")
    return (slope * (0.6 * x + 0.8 * y)).double()[..., None].expand(-1, -1, 3)


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.loss_weighting.lr_weight = 0.25
    off.adaptive_weighting.texture = 0.1
    return off


def test_the_gradient_of_a_ramp() -> None:
    magnitude = gradient_magnitude(ramp(0.03))
    torch.testing.assert_close(magnitude, torch.full((12, 15), 0.03, dtype=torch.float64))


def test_the_gradient_is_the_root_mean_square_over_channels() -> None:
    image = ramp(0.03) * torch.tensor([1.0, 2.0, 3.0])
    expected = 0.03 * (14 / 3) ** 0.5
    torch.testing.assert_close(
        gradient_magnitude(image), torch.full((12, 15), expected, dtype=torch.float64)
    )


@pytest.mark.parametrize(
    ("slope", "expected"), [(0.0, 1.0), (0.02, 0.85), (0.05, 0.625), (0.1, 0.25), (0.14, 0.25)]
)
def test_the_weight_falls_to_lr_weight_as_texture_rises(
    slope: float,
    expected: float,
    on: ComponentsConf,
    build: Callable[..., Components],
    make_view: MakeView,
    hr: Step,
) -> None:
    view = make_view("LR", ramp(slope))
    parts = build(on, hr.view, view)
    loss = torch.tensor(1.0, dtype=torch.float64)
    weighted = parts.modify_loss(loss, view.image, NO_GAUSSIANS, Step(0, 30_000, view)).item()
    assert weighted == pytest.approx(expected, rel=1e-6)
    assert parts.modify_loss(loss, hr.view.image, NO_GAUSSIANS, hr) is loss


def test_the_texture_is_averaged_over_lr_views_alone(
    on: ComponentsConf, build: Callable[..., Components], make_view: MakeView
) -> None:
    views = [make_view("LR", ramp(s)) for s in (0.02, 0.04)] + [make_view("HR", ramp(0.2))]
    (weighting,) = build(on, *views)
    for view in views[:2]:
        weight = weighting.modify_loss(
            torch.tensor(1.0).double(), view.image, NO_GAUSSIANS, Step(0, 1, view)
        ).item()
        assert weight == pytest.approx(1 - 0.75 * 0.3, rel=1e-6)
