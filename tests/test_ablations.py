"""Every file of `conf/ablation` is a delta of the baseline that gives another cell."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest
from omegaconf import OmegaConf

from xrgs.config import CONF_DIR, Conf
from xrgs.store import identity
from xrgs.sweep.axes import expand

ABLATIONS = sorted({path.stem for path in (CONF_DIR / "ablation").glob("*.yaml")} - {"baseline"})
SWEEPS = CONF_DIR / "sweeps" if (CONF_DIR / "sweeps").is_dir() else CONF_DIR.parent / "sweeps"
#: The ablation whose value each sweep of sensitivity varies, and the number of values beside it.
SENSITIVITY = {
    "consistency": ("consistency", 4),
    "decide": ("densify", 2),
    "densify": ("densify", 8),
    "loss_weight": ("loss_weighting", 3),
    "render_scale": ("render_scale", 3),
    "scale_gradient": ("gradient_scaling", 3),
}

Compose = Callable[..., Conf]


@pytest.fixture(scope="module")
def composed(compose: Compose) -> Compose:
    """(*overrides) -> their config, composed once for all tests, which must not change it."""
    return functools.cache(compose)


def cell_id(conf: Conf) -> str:
    return identity.cell_id(identity.cell_identity(conf, "variant"))


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dicts as one dict by dotted keys."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= (
            flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        )
    return result


def delta(conf: Conf, baseline: Conf) -> dict[str, Any]:
    """The values that differ from the baseline's, by key."""
    expected = flat(asdict(baseline))
    return {key: value for key, value in flat(asdict(conf)).items() if value != expected[key]}


@pytest.mark.slow
@pytest.mark.parametrize("name", ABLATIONS)
def test_each_ablation_is_another_cell(name: str, composed: Compose) -> None:
    baseline, ablation = composed(), composed(f"+ablation={name}")
    if ablation.matched_to is not None:  # a sweep fills in that cell's number of Gaussians
        ablation = composed(f"+ablation={name}", "components.count_matched.gaussians=1000")
    assert cell_id(ablation) != cell_id(baseline)
    changed = delta(ablation, baseline)
    assert {key.split(".")[0] for key in changed} <= {"components", "splat", "train", "matched_to"}


def test_the_ablation_named_baseline_is_the_baseline(composed: Compose) -> None:
    assert cell_id(composed("+ablation=baseline")) == cell_id(composed())


def test_no_two_ablations_are_the_same_cell(composed: Compose) -> None:
    confs = [composed(f"+ablation={name}") for name in ABLATIONS]
    # Two controls differ only in the cell whose number of Gaussians they have to reach.
    assert len({(cell_id(conf), conf.matched_to) for conf in confs}) == len(ABLATIONS)


@pytest.mark.parametrize(
    ("names", "whole"),
    [
        (("loss_weighting", "gradient_scaling"), "loss_gradient"),
        (("loss_weighting", "gradient_scaling", "densify", "consistency"), "xrgs"),
        (("curriculum", "render_scale"), None),
        (("loss_weighting", "consistency"), None),
        (("loss_weighting", "mip"), None),
        (("xrgs", "mip"), None),
        (("densify", "absgrad"), None),
    ],
)
def test_ablations_can_be_combined(
    names: tuple[str, ...], whole: str | None, composed: Compose
) -> None:
    baseline = composed()
    layers = [delta(composed(f"+ablation={name}"), baseline) for name in names]
    combined = composed(f"+ablation=[{','.join(names)}]")
    assert delta(combined, baseline) == {key: v for layer in layers for key, v in layer.items()}
    if whole is not None:
        assert combined == composed(f"+ablation={whole}")


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSITIVITY)
def test_a_sweep_of_sensitivity_varies_one_ablation_around_its_value(
    name: str, composed: Compose
) -> None:
    params = OmegaConf.load(SWEEPS / f"sensitivity_{name}.yaml").hydra.sweeper.params
    axes = [f"{key}={value}" for key, value in params.items() if key not in {"scene", "seed"}]
    cells = [composed(*spec.overrides) for spec in expand(axes) if spec.changes]
    around, others = SENSITIVITY[name]
    equal = [f"components.densify.lr_{key}=1" for key in ("grow", "prune") if name == "decide"]
    expected = composed(f"+ablation={around}", *equal)
    assert sum(cell == expected for cell in cells) == 1
    assert len({cell_id(cell) for cell in cells}) == len(cells) == others + 1
    changed = {key.split(".")[1] for cell in cells for key in delta(cell, composed())}
    assert len(changed) == 1, "one component"


def test_every_sweep_of_sensitivity_is_tested() -> None:
    assert {f"sensitivity_{name}" for name in SENSITIVITY} == {
        file.stem for file in SWEEPS.glob("sensitivity_*.yaml")
    }
