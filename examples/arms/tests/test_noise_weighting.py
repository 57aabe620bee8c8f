"""Weights by residuals: against numpy, torch's bicubic kernel in float64 and the likelihood."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from examples.arms.tests.conftest import with_arms
from tests.splat.scenes import noise
from tests.training.components.conftest import NO_GAUSSIANS, Build, make_view
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.training.components import Step
from xrgs.training.dataset import Dataset, LoadedView
from xrgs.training.loop import train
from xrgs_arms.noise_weighting import NoiseWeighting, Settings


def view(name: str, tag: str) -> LoadedView:
    """A black view of 60 x 75 px, or of 12 x 15."""
    size, rho = ((60, 75), 1.0) if tag == "HR" else ((12, 15), 0.2)
    return replace(make_view(tag, torch.zeros(*size, 3).double()), name=name, sampling_rate=rho)


VIEWS = {
    v.name: v for v in (view("h0", "HR"), view("h1", "HR"), view("l0", "LR"), view("l1", "LR"))
}


def weighting(floor: float = 0.1) -> NoiseWeighting:
    return NoiseWeighting(Settings(floor), [*VIEWS.values()])


def take(
    component: NoiseWeighting, name: str, residual: Tensor | float, number: int = 0
) -> tuple[float, dict[str, float]]:
    """Return the factor on the loss at a step of 100 with this residual, and the step's log."""
    step = Step(number, 100, VIEWS[name])
    image = torch.as_tensor(residual).expand(*step.view.image.shape)
    loss = component.modify_loss(torch.tensor(2.0), image, NO_GAUSSIANS, step)
    return loss.item() / 2, step.log


def test_the_weight_is_the_ratio_of_mean_squared_residuals() -> None:
    component = weighting()
    for name, residual in (("h0", 0.1), ("h1", 0.3), ("l0", 0.5), ("l1", 0.2)):
        factor, log = take(component, name, residual)
        assert factor == 1  # before `begin`
        tag = VIEWS[name].tag
        assert log == {f"noise_weighting.residual_{tag}": pytest.approx(residual)}
    # (0.1^2 + 0.3^2) / 2 is 0.05, over 0.25 and over 0.04.
    assert component.weight("l0") == pytest.approx(0.2)
    assert component.weight("l1") == 1
    factor, log = take(component, "l0", 0.5, number=50)
    assert factor == pytest.approx(0.2)
    assert log["noise_weighting.LR"] == pytest.approx(0.2)
    assert take(component, "h1", 0.3, number=50)[0] == 1
    take(component, "l0", 50.0, number=50)
    assert component.weight("l0") == 0.1  # the floor


def test_residuals_are_compared_at_the_lowest_sampling_rate() -> None:
    component, residual = weighting(), noise(60, 75, 4) - 0.5
    take(component, "h0", residual)
    small = interpolate(residual.permute(2, 0, 1)[None], (12, 15), mode="bicubic", antialias=True)
    assert component.residuals["h0"] == pytest.approx(small.square().mean().item(), rel=1e-9)
    assert component.residuals["h0"] < 0.1 * residual.square().mean().item()


def test_a_reduced_view_is_compared_at_the_same_rate() -> None:
    """Early in a run, `resolution_schedule` makes such views."""
    component = weighting()
    reduced = replace(make_view("HR", torch.zeros(30, 38, 3).double()), name="h0")
    image = torch.full((30, 38, 3), 0.3).double()
    component.modify_loss(torch.tensor(1.0), image, NO_GAUSSIANS, Step(0, 100, reduced))
    assert component.residuals["h0"] == pytest.approx(0.09)


def test_the_mean_is_over_about_ten_steps_on_the_view() -> None:
    component = weighting()
    expected = 0.0
    for count in range(1, 31):
        residual = 1 / count
        take(component, "l0", residual)
        take(component, "l1", 0.7)
        expected += (residual**2 - expected) * max(1 / count, 0.1)
        assert component.residuals["l0"] == pytest.approx(expected)
    assert component.residuals["l1"] == pytest.approx(0.49)


def test_pixels_outside_the_mask_do_not_count() -> None:
    component = weighting()
    mask = torch.zeros(12, 15, dtype=torch.bool)
    mask[:4] = True
    masked = replace(VIEWS["l0"], mask=mask)
    # The render is the photograph there.
    image = torch.where(mask[..., None], 0.3, 0.0).expand(12, 15, 3).double()
    component.modify_loss(torch.tensor(1.0), image, NO_GAUSSIANS, Step(0, 100, masked))
    assert component.residuals["l0"] == pytest.approx(0.09)


def test_a_perfect_render_and_a_view_before_any_hr_view_weigh_1() -> None:
    component = weighting()
    take(component, "l0", 0.0)
    take(component, "l1", 0.5)
    assert component.weight("l0") == component.weight("l1") == 1


@pytest.mark.parametrize("setting", [{"floor": -0.1}, {"floor": 1.1}, {"begin": -1}])
def test_a_value_out_of_range_names_its_key(
    setting: dict[str, float], build: Build, off: ComponentsConf
) -> None:
    off.plugins["noise_weighting"] = {"floor": 0.25} | setting
    ((name, value),) = setting.items()
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.noise_weighting\.{name}={value}"):
        build(off)
    off.plugins["noise_weighting"] = {"floor": 1.0}
    assert build(off) == ()
    off.plugins["noise_weighting"] = {"floor": 0.25}
    with pytest.raises(XrgsError, match=r"\.noise_weighting\.floor=0\.25: .* no HR view"):
        build(off, view("l0", "LR"))


def test_a_noisy_photograph_weighs_less_in_training(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    *others, last = data.train
    noisy = replace(data, train=(*others, replace(last, pixels=noise(12, 12, 5).float())))
    found: list[str] = []
    monkeypatch.setattr(
        NoiseWeighting, "after_training", lambda self, _: found.extend(self.findings())
    )
    settings = ("train.steps=300", "splat.backend=auto", "splat.densify.stop=15000")
    result = train(noisy, with_arms(*settings, "+ablation=noise_weighting"))
    assert found == [
        "noise_weighting: the weights of the LR photographs are 0.250 (v3) to 1.000 (v1)"
    ]
    before, after = result.history[:150], result.history[150:]
    assert {row["noise_weighting.LR"] for row in before} == {None}
    weights = {row["view"]: row["noise_weighting.LR"] for row in after}
    assert weights == {"v0": None, "v1": 1, "v2": None, "v3": 0.25}
