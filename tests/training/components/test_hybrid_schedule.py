"""Section 7.2: LR views return to their full weight after densification."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from xrgs.config import ComponentsConf
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Components, Step
from xrgs.training.components.hybrid_schedule import HybridSchedule

#: The losses of these tests do not depend on the Gaussians.
NO_GAUSSIANS = Gaussians(*[torch.empty(0)] * 6)


@pytest.fixture
def parts(build: Callable[..., Components], off: ComponentsConf) -> Components:
    off.loss_weighting.lr_weight = 0.25
    off.hybrid_schedule.ramp = 5000
    return build(off)


@pytest.mark.parametrize("total", [30_000, 3_000])
@pytest.mark.parametrize(
    ("nominal", "expected"),
    [(0, 0.25), (15_000, 0.25), (17_500, 0.625), (20_000, 1.0), (29_990, 1.0)],
)
def test_the_weight_of_lr_views_rises_after_densification(
    nominal: int, expected: float, total: int, parts: Components, hr: Step, lr: Step
) -> None:
    loss = torch.tensor(1.0, dtype=torch.float64)
    number = nominal * total // 30_000
    step = Step(number, total, lr.view)
    weighted = parts.modify_loss(loss, lr.view.image, NO_GAUSSIANS, step).item()
    assert weighted == pytest.approx(expected, rel=1e-12)
    assert step.log == {"weighting.LR": weighted}
    assert (
        parts.modify_loss(loss, hr.view.image, NO_GAUSSIANS, Step(number, total, hr.view)) is loss
    )


def test_it_starts_where_densification_is_set_to_stop(off: ComponentsConf, lr: Step) -> None:
    off.hybrid_schedule.ramp = 1000
    schedule = HybridSchedule(off.hybrid_schedule, densify_stop=2000)
    attenuations = [schedule(Step(number, 30_000, lr.view)) for number in (1999, 2000, 2400, 3000)]
    assert attenuations == pytest.approx([1.0, 1.0, 0.6, 0.0])
