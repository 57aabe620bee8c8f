"""The baseline has no component; each is on alone; a value out of range names its key."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch

from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.settings import DensifySettings
from xrgs.training.components import Component, Components, Step
from xrgs.training.components.consistency import Consistency
from xrgs.training.components.curriculum import Curriculum
from xrgs.training.components.densify import Densify
from xrgs.training.components.gradient_scaling import GradientScaling
from xrgs.training.components.mip import Mip
from xrgs.training.components.render_scale import RenderScale
from xrgs.training.components.weighting import Weighting

Build = Callable[..., Components]

#: What switches each component on, as `components.<key>`, and its class.
ON: dict[str, tuple[Any, type[Component]]] = {
    "loss_weighting.lr_weight": (0.25, Weighting),
    "gradient_scaling.lr_scale": (0.3, GradientScaling),
    "densify.decide": ("per_class", Densify),
    "curriculum.lr_only": (5000, Curriculum),
    "render_scale.gamma": (0.25, RenderScale),
    "consistency.weight": (0.1, Consistency),
    "mip.variance": (0.2, Mip),
}


def put(conf: ComponentsConf, key: str, value: Any) -> None:
    group, name = key.split(".")
    setattr(getattr(conf, group), name, value)


def test_the_baseline_has_no_component(build: Build, off: ComponentsConf) -> None:
    assert build(off) == ()


@pytest.mark.parametrize("parts", [Components(), Components([Component()])])
@pytest.mark.parametrize("tag", ["HR", "LR"])
def test_a_component_that_overrides_nothing_is_the_identity(
    parts: Components, tag: str, steps: dict[str, Step], gaussians: Gaussians
) -> None:
    step = steps[tag]
    before = {name: (gaussians[name].clone(), gaussians[name].grad.clone()) for name in PARAMETERS}
    loss = torch.tensor(0.3, requires_grad=True)
    gradient = torch.rand(6, 2)
    activated = gaussians.activated()
    assert parts.trains_on(step)
    assert parts.activated(activated, step) is activated
    assert parts.pixel_weight(step) is None
    assert parts.loss(loss, step.view.image, step) is loss
    assert parts.densification_grad2d(gradient, step) is gradient
    assert parts.groups(DensifySettings()) is None
    parts.after_backward(gaussians, step)
    parts.on_gaussians_changed(gaussians)
    parts.finish(gaussians)
    for name, (value, grad) in before.items():
        assert torch.equal(gaussians[name], value), name
        assert torch.equal(gaussians[name].grad, grad), name


@pytest.mark.parametrize("key", ON)
def test_each_is_on_alone(key: str, build: Build, off: ComponentsConf) -> None:
    value, kind = ON[key]
    put(off, key, value)
    assert [type(component) for component in build(off)] == [kind]


def test_all_are_on_together(build: Build, off: ComponentsConf) -> None:
    for key, (value, _) in ON.items():
        put(off, key, value)
    assert {type(component) for component in build(off)} == {kind for _, kind in ON.values()}


def test_training_needs_no_hydra() -> None:
    code = "import sys, xrgs.training.components; sys.exit('hydra' in sys.modules)"
    run = subprocess.run([sys.executable, "-P", "-c", code], check=False)
    assert run.returncode == 0


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("loss_weighting.lr_weight", -0.1),
        ("loss_weighting.lr_weight", float("nan")),
        ("gradient_scaling.lr_scale", float("inf")),
        ("densify.lr_grow", -2.0),
        ("densify.lr_prune", float("nan")),
        ("curriculum.lr_only", -1),
        ("render_scale.gamma", -0.25),
        ("consistency.weight", -1.0),
        ("consistency.l1", -1.0),
        ("consistency.ssim", -1.0),
        ("adaptive_weighting.texture", -0.1),
        ("region_weighting.texture", float("nan")),
        ("hybrid_schedule.ramp", -1),
        ("continuous_weighting.gamma", -0.43),
        ("mip.variance", -0.2),
        ("mip.every", 0),
    ],
)
def test_a_value_out_of_range_names_its_key(
    key: str, value: Any, build: Build, off: ComponentsConf
) -> None:
    put(off, key, value)
    with pytest.raises(XrgsError) as caught:
        build(off)
    assert str(caught.value).startswith(f"components.{key}={value}")


def test_where_a_step_is_in_the_nominal_run(hr: Step) -> None:
    assert Step(300, 3000, hr.view).nominal == 3000
    assert hr.nominal == 0
