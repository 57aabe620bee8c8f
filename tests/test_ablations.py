"""Every file of `conf/ablation`: a delta of the baseline, another cell, and a layer for others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest

from xrgs.config import CONF_DIR, Conf
from xrgs.experiment.identity import cell_identity
from xrgs.safeio.hashing import digest

ABLATIONS = sorted({path.stem for path in (CONF_DIR / "ablation").glob("*.yaml")} - {"baseline"})

Compose = Callable[..., Conf]


def cell_id(conf: Conf) -> str:
    return digest(cell_identity(conf, "variant"))


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= (
            flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        )
    return found


def delta(conf: Conf, baseline: Conf) -> dict[str, Any]:
    """What differs, by key."""
    plain = flat(asdict(baseline))
    return {key: value for key, value in flat(asdict(conf)).items() if value != plain[key]}


@pytest.mark.parametrize("name", ABLATIONS)
def test_each_is_another_cell(name: str, compose: Compose) -> None:
    baseline, ablation = compose(), compose(f"+ablation={name}")
    if ablation.matched_to is not None:  # the sweep gives it the number of that cell's Gaussians
        ablation = compose(f"+ablation={name}", "components.count_matched.gaussians=1000")
    assert cell_id(ablation) != cell_id(baseline)
    changed = delta(ablation, baseline)
    assert {key.split(".")[0] for key in changed} <= {"components", "splat", "train", "matched_to"}


def test_the_one_called_baseline_is_the_baseline(compose: Compose) -> None:
    assert cell_id(compose("+ablation=baseline")) == cell_id(compose())


def test_no_two_are_the_same_cell(compose: Compose) -> None:
    confs = [compose(f"+ablation={name}") for name in ABLATIONS]
    # Two controls differ only in the cell whose number of Gaussians they are to have.
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
def test_they_stack(names: tuple[str, ...], whole: str | None, compose: Compose) -> None:
    baseline = compose()
    layers = [delta(compose(f"+ablation={name}"), baseline) for name in names]
    stacked = compose(f"+ablation=[{','.join(names)}]")
    assert delta(stacked, baseline) == {key: v for layer in layers for key, v in layer.items()}
    if whole is not None:
        assert stacked == compose(f"+ablation={whole}")
