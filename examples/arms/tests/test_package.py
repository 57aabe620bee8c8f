"""The entry points of the package, and the identity of their cells."""

from __future__ import annotations

import tomllib

from examples.arms.tests.conftest import ARMS, with_arms
from tests.test_ablations import cell_id
from xrgs import plugins

PROJECT = tomllib.loads((ARMS / "pyproject.toml").read_text())["project"]
NAMES = PROJECT["entry-points"][plugins.GROUP].keys()


def test_each_ablation_is_an_entry_point() -> None:
    assert {file.stem for file in (ARMS / "conf/ablation").glob("*.yaml")} == NAMES


def test_each_is_another_cell_and_they_can_be_combined() -> None:
    confs = {name: with_arms(f"+ablation={name}") for name in NAMES}
    for name, conf in confs.items():
        assert [*conf.components.plugins] == [name]
    assert len({cell_id(conf) for conf in (with_arms(), *confs.values())}) == len(NAMES) + 1
    assert with_arms(f"+ablation=[{','.join(NAMES)}]").components.plugins.keys() == NAMES
