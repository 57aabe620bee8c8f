"""The components that a config builds: none in the baseline, and each by its own setting."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf, Conf, DensifyConf, identity_values, is_on
from xrgs.errors import XrgsError
from xrgs.registry import BUILT_IN, file_of
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.settings import DensifySettings
from xrgs.splat.strategy.base import Groups, Thresholds
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.splat.strategy.mcmc import MCMCStrategy
from xrgs.training import components
from xrgs.training.components import Component, Components, Step
from xrgs.training.components.densify import Densify

#: What switches each component on, as `components.<key>`.
ON: dict[str, Any] = {
    "loss_weighting.lr_weight": 0.25,
    "gradient_scaling.lr_scale": 0.3,
    "densify.decide": "per_class",
    "curriculum.lr_only": 5000,
    "render_scale.gamma": 0.25,
    "consistency.weight": 0.1,
    "mip.variance": 0.2,
    "supersampled.factor": 2,
    "supersampled.late_factor": 2,
    "formation.widths": "tag",
    "resolution_schedule.start_share": 0.5,
    "natural_selection.budget": 0.5,
    "exposure.mode": "gain",
    "regularization.opacity": 0.01,
    "regularization.scale": 0.01,
    "floaters.near_share": 0.5,
    "continuous_weighting.gamma": 1.0,
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


def kind_of(key: str) -> str:
    """The class that a key of `ON` switches on."""
    group = key.partition(".")[0]
    (found,) = (e.name for name, e in BUILT_IN.items() if group in (name, *e.reads))
    return found


def put(conf: ComponentsConf, key: str, value: Any) -> None:
    group, name = key.split(".")
    setattr(getattr(conf, group), name, value)


def groups_on(conf: ComponentsConf) -> list[str]:
    """The groups of settings in the identities of cells."""
    assert [*identity_values(conf)] == [
        group for group, values in vars(conf).items() if group != "plugins" and is_on(values)
    ]
    return [*identity_values(conf)]


def test_every_setting_has_a_component() -> None:
    """A component of its own, one that reads it, count matching or the plugins."""
    keys = {field.name for field in dataclasses.fields(ComponentsConf)}
    read = {key for entry in BUILT_IN.values() for key in entry.reads}
    assert keys == set(BUILT_IN) | read | {"count_matched", "plugins"}
    assert not read & set(BUILT_IN)


def test_every_module_implements_a_component_or_is_shared() -> None:
    folder = Path(components.__file__).parent
    shared = {"__init__", "adam", "base"}
    modules = {file.stem for file in folder.glob("*.py")} - shared
    keys = [key for name, entry in BUILT_IN.items() for key in (name, *entry.reads)]
    assert {file_of(key) for key in keys} == {f"training/components/{name}.py" for name in modules}
    assert file_of("count_matched") is file_of("plugins") is None
    hooks = {name for name in vars(Component) if not name.startswith("_")}
    assert hooks - vars(Components).keys() == {"settings_type", "from_settings"}


def test_components_that_can_not_decide_together_are_refused() -> None:
    densify = Densify(DensifyConf(decide="per_class", lr_grow=2.0, lr_prune=2.0))
    assert Components([Component(), densify]).densification_groups(DensifySettings()) is not None
    ranked = Components([Component(), densify, Other()])
    with pytest.raises(XrgsError, match=r"^components: Densify and Other both set thresholds"):
        ranked.densification_groups(DensifySettings())
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


def test_each_key_builds_its_component_and_the_baseline_none(build: Build, baseline: Conf) -> None:
    for key, value in ON.items():
        conf = deepcopy(baseline.components)
        assert build(conf) == ()
        assert groups_on(conf) == []
        put(conf, key, value)
        assert [type(component).__name__ for component in build(conf)] == [kind_of(key)]
        assert groups_on(conf) == [key.partition(".")[0]]
    for key, value in OTHERS.items():
        conf = deepcopy(baseline.components)
        put(conf, key, value)
        assert build(conf) == ()
        assert groups_on(conf) == [key.partition(".")[0]]
    for key in ("consistency.l1", "densify.lr_grow", "supersampled.late_from"):
        conf = deepcopy(baseline.components)  # keys of components that are off
        put(conf, key, 3)
        assert build(conf) == ()
        assert groups_on(conf) == []


@pytest.mark.parametrize("key", ATTENUATIONS)
def test_an_attenuation_is_refused_alone_and_is_in_the_identity(
    key: str, build: Build, off: ComponentsConf
) -> None:
    put(off, key, ATTENUATIONS[key])
    with pytest.raises(XrgsError, match=rf"^components\.{key}="):
        build(off)
    off.loss_weighting.lr_weight = 0.5
    assert [type(component).__name__ for component in build(off)] == ["Weighting"]
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


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mip.every", 0),
        ("regularization.opacity", -0.01),
        ("regularization.scale", -0.01),
        ("natural_selection.drop_every", 0),
        ("natural_selection.until", 16_000),
        ("natural_selection.until", 30_001),
        ("resolution_schedule.start_share", 0.0),
        ("resolution_schedule.start_share", 1.5),
        ("resolution_schedule.until", 0),
        ("supersampled.factor", 0),
        ("supersampled.late_factor", 0),
        ("exposure.lr_final", 0.0),
    ],
)
def test_a_value_out_of_range_names_its_key(
    key: str, value: Any, build: Build, off: ComponentsConf
) -> None:
    """Others are in tests/test_config.py, which tries every key of the components."""
    for name, on in ON.items():
        if name.partition(".")[0] == key.partition(".")[0]:
            put(off, name, on)
    put(off, key, value)
    with pytest.raises(XrgsError) as caught:
        build(off)
    assert str(caught.value).startswith(f"components.{key}={value}")
