"""The documentation is a site that builds without a warning; what is made of code is complete."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import pytest

import xrgs
from xrgs.cli.sweep import entries
from xrgs.registry import BUILT_IN

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


class Page(HTMLParser):
    """The ids of a page's elements, its text, and the names of its elements."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.ids = set[str]()
        self.elements = set[str]()
        self.text = ""
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.add(tag)
        self.ids |= {value for name, value in attrs if name == "id" and value}

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site; a link that leads nowhere ends the build."""
    folder = tmp_path_factory.mktemp("site")
    build = ("-m", "mkdocs", "build", "--strict", "--site-dir", str(folder))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *build],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_key_has_an_anchor(site: Path) -> None:
    assert set(entries()) <= Page(site / "conf/config/index.html").ids


def test_every_file_of_conf_has_an_anchor(site: Path) -> None:
    ids = Page(site / "conf/files/index.html").ids
    assert {f"ablation-{file.stem}" for file in (ROOT / "conf/ablation").glob("*.yaml")} <= ids
    assert {f"sweeps-{file.stem}" for file in (ROOT / "sweeps").glob("*.yaml")} <= ids
    assert "scene-llff-fern" in ids


def test_every_command_is_there_with_its_options(site: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    page = Page(site / "commands/index.html")
    assert set(project["scripts"]) <= page.ids
    for option in ("--dry-run", "--against LABEL", "--path", "--sha256 HEX", "limits.minutes=N"):
        assert option in page.text


def test_every_public_name_and_every_component_is_there(site: Path) -> None:
    assert {f"xrgs.{name}" for name in xrgs.__all__} <= Page(site / "api/index.html").ids
    components = Page(site / "components/index.html")
    assert all(key in components.text for key in BUILT_IN)
    assert "Section 5.6 of the paper adds to the loss of every view" in components.text


def test_formulas_are_mathml(site: Path) -> None:
    page = Page(site / "rasterizer/index.html")
    assert {"math", "msqrt", "mfrac", "mtable"} <= page.elements
    assert "(32)" in page.text
    assert r"\bar" not in page.text


def test_links_lead_to_files_of_the_repository(site: Path) -> None:
    """README.md is the home page; notes of studies, tables and figures are part of the site."""
    home = (site / "index.html").read_text(encoding="utf-8")
    assert 'href="reports/recipes/NOTES/"' in home
    assert 'href="conf/config/"' in (site / "study/index.html").read_text().replace("../", "")
    assert (site / "reports/recipes/figures/flower--plus.png").is_file()
    assert (site / "reports/recipes/table/index.html").is_file()


def test_every_study_is_in_the_navigation() -> None:
    studies = {str(file.relative_to(ROOT)) for file in ROOT.glob("reports/*/NOTES.md")}
    listed = set(re.findall(r"reports/\w+/NOTES\.md", (ROOT / "mkdocs.yml").read_text("utf-8")))
    assert listed == studies
