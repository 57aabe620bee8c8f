"""Installs the arms for the tests, and imports the fixtures of the tests of xrgs's components."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import baseline, compose, composed, data
from tests.splat.conftest import backend
from tests.training.components.conftest import build, hr, lr, off, shown, steps, views
from tests.training.conftest import short
from xrgs.config import Conf

__all__ = [
    "backend", "baseline", "build", "compose", "data", "hr", "lr", "off", "short", "shown", "steps",
    "views",
]  # fmt: skip

ARMS = Path(__file__).parents[1]


def with_arms(*overrides: str) -> Conf:
    """The config of `xrgs-sweep --config-dir examples/arms/conf` with these overrides."""
    return composed(f"hydra.searchpath=[file://{ARMS / 'conf'}]", *overrides)


@pytest.fixture(scope="session", autouse=True)
def _installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Offer the entry points of `pyproject.toml`, as pip would; pytest finds the modules."""
    project = tomllib.loads((ARMS / "pyproject.toml").read_text())["project"]
    (points,) = project["entry-points"].items()
    folder = tmp_path_factory.mktemp("site")
    (info := folder / "xrgs_arms-0.1.0.dist-info").mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: xrgs-arms\nVersion: 0.1.0\n")
    lines = [f"{name} = {value}" for name, value in points[1].items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{points[0]}]", *lines]))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield
