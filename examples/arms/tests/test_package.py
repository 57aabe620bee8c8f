"""The entry points of the package, and the identity of their cells."""

from __future__ import annotations

import tomllib

import pytest

from examples.arms.tests.conftest import ARMS, with_arms
from tests.test_ablations import cell_id
from xrgs import plugins
from xrgs.composing import ARMS as NAMES

POINTS = tomllib.loads((ARMS / "pyproject.toml").read_text())["project"]["entry-points"]


def test_each_ablation_is_an_entry_point_that_xrgs_names() -> None:
    files = {file.stem for file in (ARMS / "conf/ablation").glob("*.yaml")}
    assert files == POINTS[plugins.GROUP].keys() == NAMES


@pytest.mark.parametrize("name", sorted(NAMES))
def test_each_is_another_cell(name: str) -> None:
    conf = with_arms(f"+ablation={name}")
    assert [*conf.components.plugins] == [name]
    others = [with_arms(), *(with_arms(f"+ablation={other}") for other in NAMES - {name})]
    assert cell_id(conf) not in {cell_id(other) for other in others}


def test_the_arms_can_be_combined() -> None:
    assert with_arms(f"+ablation=[{','.join(NAMES)}]").components.plugins.keys() == NAMES
