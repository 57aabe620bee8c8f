"""The components that a config builds: none in the baseline, and each by its own setting."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from xrgs.config import ComponentsConf, DensifyConf, identity_values, is_on
from xrgs.errors import XrgsError
from xrgs.registry import BUILT_IN, file_of
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.splat.strategy.mcmc import MCMCStrategy
from xrgs.splat.strategy.refinement import Groups, Thresholds
from xrgs.training import components
from xrgs.training.components import Component, Components, Step
from xrgs.training.components.consistency import Consistency
from xrgs.training.components.curriculum import Curriculum
from xrgs.training.components.densify import Densify
from xrgs.training.components.exposure import Exposure
from xrgs.training.components.floaters import Floaters
from xrgs.training.components.gradient_scaling import GradientScaling
from xrgs.training.components.mip import Mip
from xrgs.training.components.natural_selection import NaturalSelection
from xrgs.training.components.regularization import Regularization
from xrgs.training.components.render_scale import RenderScale
from xrgs.training.components.resolution_schedule import ResolutionSchedule
from xrgs.training.components.supersampled import Supersampled
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
    "supersampled.factor": (2, Supersampled),
    "supersampled.late_factor": (2, Supersampled),
    "formation.widths": ("tag", Supersampled),
    "resolution_schedule.start_share": (0.5, ResolutionSchedule),
    "natural_selection.budget": (0.5, NaturalSelection),
    "exposure.mode": ("gain", Exposure),
    "regularization.opacity": (0.01, Regularization),
    "regularization.scale": (0.01, Regularization),
    "floaters.near_share": (0.5, Floaters),
    "continuous_weighting.gamma": (1.0, Weighting),
}
#: Keys that `off` declares too, with another value: they build no component by themselves. The
#: first three change what another key switches on, as do those of `ATTENUATIONS`, which are refused
#: without one; the last is read by `xrgs.training.count_matching`.
OTHERS: dict[str, Any] = {
    "loss_weighting.stat_from": "unweighted",
    "natural_selection.drop_every": 100,
    "count_matched.gaussians": 100,
}
ATTENUATIONS: dict[str, Any] = {
    "adaptive_weighting.texture": 0.1,
    "region_weighting.texture": 0.1,
    "hybrid_schedule.ramp": 100,
}


def put(conf: ComponentsConf, key: str, value: Any) -> None:
    group, name = key.split(".")
    setattr(getattr(conf, group), name, value)


def groups_on(conf: ComponentsConf) -> list[str]:
    """The groups of settings in the identities of cells."""
    assert [*identity_values(conf)] == [
        group for group, values in vars(conf).items() if group != "plugins" and is_on(values)
    ]
    return [*identity_values(conf)]


def test_the_baseline_has_no_component(build: Build, off: ComponentsConf) -> None:
    assert build(off) == ()
    assert groups_on(off) == []


def test_every_setting_has_a_component() -> None:
    """A component of its own, one that reads it, count matching or the plugins."""
    keys = {field.name for field in dataclasses.fields(ComponentsConf)}
    read = {key for entry in BUILT_IN.values() for key in entry.reads}
    assert keys == set(BUILT_IN) | read | {"count_matched", "plugins"}
    assert not read & set(BUILT_IN)


def test_every_module_implements_a_component_or_is_shared() -> None:
    folder = Path(components.__file__).parent
    shared = {"__init__", "adam", "base", "combined", "formation", "texture"}
    modules = {file.stem for file in folder.glob("*.py")} - shared
    keys = [key for name, entry in BUILT_IN.items() for key in (name, *entry.reads)]
    assert {file_of(key) for key in keys} == {f"training/components/{name}.py" for name in modules}
    assert file_of("hybrid_schedule") == "training/components/weighting.py"
    assert file_of("count_matched") is None
    assert file_of("plugins") is None


def test_every_hook_is_combined() -> None:
    hooks = {name for name in vars(Component) if not name.startswith("_")}
    assert hooks - vars(Components).keys() == {"settings_type", "from_settings"}


def test_two_components_with_thresholds_are_refused() -> None:
    densify = Densify(DensifyConf(decide="per_class", lr_grow=2.0, lr_prune=2.0))
    assert Components([Component(), densify]).densification_groups(DensifySettings()) is not None
    with pytest.raises(XrgsError, match=r"^components: Densify and Other both set thresholds"):
        Components([densify, Other()]).densification_groups(DensifySettings())


def test_components_that_decide_what_grows_are_refused_by_a_strategy_that_draws() -> None:
    densify = Densify(DensifyConf(decide="per_class", lr_grow=2.0, lr_prune=2.0))
    ranked = Components([Component(), densify, Other()])
    ranked.check_strategy("default", DefaultStrategy)
    Components([Component()]).check_strategy("mcmc", MCMCStrategy)
    with pytest.raises(XrgsError, match=r"^splat\.strategy=mcmc: .* Densify and Other would"):
        ranked.check_strategy("mcmc", MCMCStrategy)


class Other(Component):
    """A component with thresholds of densification, and with a state."""

    def __init__(self) -> None:
        self.count = 0

    def densification_groups(self, settings: DensifySettings) -> Groups:
        return Groups({"HR": Thresholds(1.0, 1.0), "LR": Thresholds(1.0, 1.0)}, "per_class")

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count} if self.count else {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.count = state["count"]


def test_the_states_of_two_components_of_one_class_are_kept_apart() -> None:
    kinds = Other(), Component(), Other(), Other()
    kinds[0].count, kinds[2].count = 1, 2
    states = Components(kinds).state_dict()
    assert states == {"0.Other": {"count": 1}, "2.Other": {"count": 2}}
    again = Other(), Component(), Other(), Other()
    Components(again).load_state_dict(states)
    assert [again[0].count, again[2].count, again[3].count] == [1, 2, 0]


class Choosing(Component):
    """A component that answers all that densification asks, from the same six numbers."""

    def __init__(self, *numbers: float) -> None:
        self.numbers = torch.tensor(numbers)

    def may_grow(self, gaussians: Gaussians, step: Step) -> Tensor:
        return self.numbers > 0

    def growth_scores(self, gaussians: Gaussians, step: Step) -> Tensor:
        return self.numbers

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor:
        return self.numbers > 2


def test_the_answers_of_components_are_combined(hr: Step, gaussians: Gaussians) -> None:
    parts = Components([Choosing(0, 1, 2, 3, 0, 5), Component(), Choosing(3, 3, 0, 1, 0, 1)])
    may_grow = parts.may_grow(gaussians, hr)
    scores = parts.growth_scores(gaussians, hr)
    pruned = parts.to_prune(gaussians, hr)
    assert may_grow is not None
    assert scores is not None
    assert pruned is not None
    assert may_grow.tolist() == [False, True, False, True, False, True]
    assert scores.tolist() == [0, 3, 0, 3, 0, 5]
    assert pruned.tolist() == [True, True, False, True, False, True]


@pytest.mark.parametrize("key", ON)
def test_each_is_on_alone(key: str, build: Build, off: ComponentsConf) -> None:
    value, kind = ON[key]
    put(off, key, value)
    assert [type(component) for component in build(off)] == [kind]
    assert groups_on(off) == [key.partition(".")[0]]


@pytest.mark.parametrize("key", OTHERS)
def test_other_keys_build_nothing_and_are_in_the_identity(
    key: str, build: Build, off: ComponentsConf
) -> None:
    put(off, key, OTHERS[key])
    assert build(off) == ()
    assert groups_on(off) == [key.partition(".")[0]]


@pytest.mark.parametrize("key", ATTENUATIONS)
def test_an_attenuation_is_refused_alone_and_is_in_the_identity(
    key: str, build: Build, off: ComponentsConf
) -> None:
    put(off, key, ATTENUATIONS[key])
    with pytest.raises(XrgsError, match=rf"^components\.{key}="):
        build(off)
    off.loss_weighting.lr_weight = 0.5
    assert [type(component) for component in build(off)] == [Weighting]
    assert set(groups_on(off)) == {"loss_weighting", key.partition(".")[0]}


def test_every_key_that_is_declared_off_is_one_of_these(off: ComponentsConf) -> None:
    declared = {
        f"{group.name}.{key.name}"
        for group in dataclasses.fields(off)
        if group.name != "plugins"
        for key in dataclasses.fields(getattr(off, group.name))
        if "off" in key.metadata
    }
    assert declared == ON.keys() | OTHERS.keys() | ATTENUATIONS.keys()
    assert {key.partition(".")[0] for key in declared} | {"plugins"} == set(vars(off))


@pytest.mark.parametrize("key", ["consistency.l1", "densify.lr_grow", "supersampled.late_from"])
def test_a_key_of_a_component_that_is_off_switches_nothing_on(
    key: str, build: Build, off: ComponentsConf
) -> None:
    put(off, key, 3)
    assert build(off) == ()
    assert groups_on(off) == []


def test_all_are_on_together(build: Build, off: ComponentsConf) -> None:
    for key, (value, _) in ON.items():
        put(off, key, value)
    assert {type(component) for component in build(off)} == {kind for _, kind in ON.values()}


@pytest.mark.parametrize(
    ("module", "unused"),
    [
        (
            "training.loop",
            {"hydra", *(f"xrgs.training.components.{e.module}" for e in BUILT_IN.values())},
        ),
        ("registry", {"torch", "numpy", "omegaconf", "hydra"}),
    ],
)
@pytest.mark.slow
def test_what_is_imported(module: str, unused: set[str]) -> None:
    """Training needs no Hydra and no component; planning reads the registry without torch."""
    code = f"import sys, xrgs.{module}; print({unused!r} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, check=True)
    assert run.stdout.strip() == b"set()"


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
        ("regularization.opacity", -0.01),
        ("regularization.scale", float("inf")),
        ("natural_selection.budget", -1.0),
        ("natural_selection.budget", float("nan")),
        ("natural_selection.until", 16_000),
        ("natural_selection.until", 30_001),
        ("floaters.near_share", -0.5),
        ("resolution_schedule.start_share", 0.0),
        ("resolution_schedule.start_share", 1.5),
        ("resolution_schedule.until", 0),
        ("supersampled.factor", 0),
        ("supersampled.late_factor", 0),
        ("loss_weighting.stat_from", "both"),
        ("consistency.lr_mode", "folded"),
        ("densify.decide", "everybody"),
    ],
)
def test_a_value_out_of_range_names_its_key(
    key: str, value: Any, build: Build, off: ComponentsConf
) -> None:
    for name, (on, _) in ON.items():
        if name.partition(".")[0] == key.partition(".")[0]:
            put(off, name, on)
    put(off, key, value)
    with pytest.raises(XrgsError) as caught:
        build(off)
    assert str(caught.value).startswith(f"components.{key}={value}")


def test_where_a_step_is_in_the_nominal_run(hr: Step) -> None:
    assert Step(300, 3000, hr.view).nominal == 3000
    assert hr.nominal == 0


def test_own_thresholds_of_zero_are_refused(build: Build, off: ComponentsConf) -> None:
    off.densify.decide, off.densify.lr_grow = "own_threshold", 0.0
    with pytest.raises(XrgsError, match=r"^components\.densify\.lr_grow=0"):
        build(off)
