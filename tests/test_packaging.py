"""What the package says of itself is what the workflows test and what is installed."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.version import Version

import xrgs
from xrgs.config import CONF_DIR

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PROJECT: dict[str, Any] = PYPROJECT["project"]


def workflow(name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((ROOT / ".github" / "workflows" / name).read_text())
    return loaded


def test_the_package_is_for_the_pythons_and_systems_that_the_workflow_tests() -> None:
    jobs = workflow("ci.yml")["jobs"]
    pythons = jobs["test"]["strategy"]["matrix"]["python"]
    prefix = "Programming Language :: Python :: 3."
    named = [c.removeprefix(prefix) for c in PROJECT["classifiers"] if c.startswith(prefix)]
    assert [f"3.{minor}" for minor in named] == pythons
    assert PROJECT["requires-python"] == f">={pythons[0]}"
    built = PYPROJECT["tool"]["cibuildwheel"]["build"]
    assert built == [f"cp{version.replace('.', '')}-*" for version in pythons]
    systems = [c for c in PROJECT["classifiers"] if c.startswith("Operating System")]
    assert {job["runs-on"].partition("-")[0] for job in jobs.values()} == {"ubuntu"}
    assert systems == ["Operating System :: POSIX :: Linux"]


@pytest.mark.parametrize(("name", "inside"), [("conf", "."), ("sweeps", "sweeps")])
def test_every_config_file_is_installed(name: str, inside: str) -> None:
    installed = CONF_DIR / inside if CONF_DIR != ROOT / "conf" else ROOT / name
    files = sorted(file.relative_to(ROOT / name) for file in (ROOT / name).rglob("*.yaml"))
    assert len(files) >= 2
    for file in files:
        assert (installed / file).read_bytes() == (ROOT / name / file).read_bytes()


def test_every_action_is_pinned_to_a_commit() -> None:
    for file in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        uses = re.findall(r"uses: (\S+)", file.read_text("utf-8"))
        assert uses
        assert all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", action) for action in uses)


def test_the_version_is_the_same_everywhere() -> None:
    version = PROJECT["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert metadata.version("xrgs") == xrgs.__version__ == version
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    releases = re.findall(r"^## \[(\d[\d.]*)\] - (\d{4}-\d{2}-\d{2})$", changes, re.MULTILINE)
    assert releases[0] == (citation["version"], str(citation["date-released"]))
    if Version(version).is_devrelease:
        assert Version(citation["version"]) < Version(version)
    else:
        assert citation["version"] == version


def test_commands_and_types_are_installed() -> None:
    for name, value in PROJECT["scripts"].items():
        (command,) = metadata.entry_points(group="console_scripts", name=name)
        assert command.value == value
        assert callable(command.load())
    assert (Path(xrgs.__file__).parent / "py.typed").is_file()
