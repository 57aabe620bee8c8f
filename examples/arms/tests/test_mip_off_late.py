"""The 3D filter becomes part of the Gaussians before its last step."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from examples.arms.tests.conftest import with_arms
from tests.training.components.test_mip import CLOSE, FAR, NEAR, STEP, splats, view
from tests.training.conftest import comparable, same
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import Gaussians
from xrgs.training.components import Components, Step
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs_arms.mip_off_late import MipOffLate, Settings

STEPS = ("train.steps=20", "splat.backend=auto", "splat.densify.stop=1")


def test_before_its_end_the_filter_becomes_part_of_the_gaussians() -> None:
    gaussians = splats((0.0, 0.0, 0.0), (0.1, 0.05, 0.5), (50.0, 0.0, 0.0))
    views = [view("HR", FAR), view("LR", CLOSE)]
    mip = MipOffLate(Settings(variance=0.2), views, NEAR)
    mip.on_gaussians_changed(gaussians)
    before, last = (Step(number, 300, STEP.view) for number in (198, 199))
    filtered = mip.before_render(gaussians.activated(), last)
    parameters = gaussians.scales, gaussians.opacities
    mip.after_step(gaussians, before)
    assert not torch.equal(gaussians.activated().scales, filtered.scales)
    mip.after_step(gaussians, last)
    assert gaussians.scales is parameters[0]  # the optimizer's own tensors
    assert gaussians.opacities is parameters[1]
    activated = gaussians.activated()
    torch.testing.assert_close(activated.scales, filtered.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(activated.opacities, filtered.opacities, rtol=1e-6, atol=0)
    # From there on nothing filters them a second time.
    first = Step(200, 300, STEP.view)
    assert mip.before_render(activated, first) is activated
    assert first.log == {}
    assert mip.opacity_attenuation(gaussians) is None
    values = [parameter.detach().clone() for parameter in parameters]
    mip.on_gaussians_changed(gaussians)
    mip.after_step(gaussians, first)
    mip.bake(gaussians)
    assert all(torch.equal(*pair) for pair in zip(values, parameters, strict=True))


def test_the_model_at_the_end_of_the_filter_is_the_one_with_it(data: Dataset) -> None:
    """The evaluated Gaussians are those of a training that keeps the filter, bit for bit."""
    found = []
    for until in (15_000, 30_000):
        late = ("+ablation=mip_off_late", f"components.plugins.mip_off_late.until={until}")
        conf = with_arms(*STEPS, *late, "train.evaluate_every=10")
        seen: list[Gaussians] = []

        def look(gaussians: Gaussians, seen: list[Gaussians] = seen) -> dict[str, float | None]:
            seen.append(gaussians)
            return {}

        result = train(data, conf, evaluate=look)
        found.append((*seen, result.gaussians))
    (halfway, ended), (kept_halfway, kept) = found
    assert same(halfway, kept_halfway)
    assert not same(ended, kept)


def test_a_filter_that_never_ends_is_mip(data: Dataset) -> None:
    steps = ("train.steps=20", "splat.backend=auto")
    never = ("+ablation=mip_off_late", "components.plugins.mip_off_late.until=40000")
    plain, late = (
        comparable(train(data, with_arms(*steps, *more))) for more in (["+ablation=mip"], never)
    )
    del plain["memory_bytes"], late["memory_bytes"]
    assert plain == late


@pytest.mark.parametrize("setting", [{"variance": -0.2}, {"every": 0}, {"until": 0}])
def test_a_value_out_of_range_names_its_key(
    setting: dict[str, float], build: Callable[..., Components], off: ComponentsConf
) -> None:
    off.plugins["mip_off_late"] = {"variance": 0.2} | setting
    ((name, value),) = setting.items()
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.mip_off_late\.{name}={value}"):
        build(off)
    off.plugins["mip_off_late"] = {"variance": 0.0}
    assert build(off) == ()
