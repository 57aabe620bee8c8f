"""Every file of `conf/ablation` is a delta of the baseline that gives another cell."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from xrgs.composing import from_dict
from xrgs.config import CONF_DIR, Conf
from xrgs.store import identity
from xrgs.sweep.axes import expand

ABLATIONS = sorted({path.stem for path in (CONF_DIR / "ablation").glob("*.yaml")} - {"baseline"})
SWEEPS = CONF_DIR / "sweeps" if (CONF_DIR / "sweeps").is_dir() else CONF_DIR.parent / "sweeps"
STUDY = Path(__file__).parents[1] / "docs" / "study.md"

Compose = Callable[..., Conf]


@pytest.fixture(scope="module")
def composed(compose: Compose) -> Compose:
    """(*overrides) -> their config, composed once for all tests, which must not change it.

    Each is read back from JSON.
    """

    @functools.cache
    def made(*overrides: str) -> Conf:
        conf = compose(*overrides)
        assert from_dict(json.loads(json.dumps(asdict(conf)))) == conf
        return conf

    return made


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
def test_each_ablation_is_a_cell_of_its_own_and_changes_training_only(composed: Compose) -> None:
    assert cell_id(composed("+ablation=baseline")) == cell_id(composed())
    # Two controls differ only in the cell whose number of Gaussians they have to reach.
    cells: dict[tuple[str, str | None], str] = {(cell_id(composed()), None): "baseline"}
    for name in ABLATIONS:
        conf = composed(f"+ablation={name}")
        assert cells.setdefault((cell_id(conf), conf.matched_to), name) == name
        changed = {key.split(".")[0] for key in delta(conf, composed())}
        assert changed <= {"components", "splat", "train", "matched_to"}, name


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted(SWEEPS.glob("*.yaml")), ids=lambda file: file.stem)
def test_each_value_of_a_sweep_file_makes_a_config(file: Path, composed: Compose) -> None:
    """Each value by itself; tests/cli/test_sweep.py plans whole files."""
    composed(f"+sweeps={file.stem}")
    axes = OmegaConf.load(file).hydra.sweeper.params
    specs = {key: expand([f"{key}={values}"]) for key, values in axes.items()}
    labels = {spec.label for spec in specs.get("+ablation", ())}
    for key, of_key in specs.items():
        for spec in of_key:
            if key == "matched_to":
                assert spec.matched_to is None or spec.matched_to in labels
            else:
                composed(*spec.overrides)


@pytest.mark.slow
def test_the_settings_of_the_table_of_sensitivity_each_vary_one_component(
    composed: Compose,
) -> None:
    rows = re.findall(r"^\| (`components.*?) \| `([\w.,]+)`", STUDY.read_text(), re.MULTILINE)
    assert len(rows) == 6
    for setting, values in rows:
        on = re.findall(r"`(\+\S+)`", setting)
        for key in re.findall(r"`(components\.\w+\.\w+)`", setting):
            cells = [composed(*on, f"{key}={value}") for value in values.split(",")]
            assert len({cell_id(cell) for cell in cells}) == len(cells)
            changed = {name for cell in cells for name in delta(cell, composed())}
            assert {name.split(".")[1] for name in changed} == {key.split(".")[1]}
