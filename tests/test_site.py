"""What docs/site_hooks.py makes for the site is complete; a workflow builds the site, strictly."""

from __future__ import annotations

import html
import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import xrgs
from xrgs.cli.sweep import entries
from xrgs.registry import BUILT_IN

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    """`docs/site_hooks.py` as a module."""
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def anchors(page: str) -> set[str]:
    return set(re.findall(r"^##.* \{ #(\S+) \}$", page, re.MULTILINE))


def test_every_key_has_an_anchor(hooks: ModuleType) -> None:
    assert set(entries()) <= anchors(hooks.keys_page())


def test_every_file_of_conf_has_an_anchor(hooks: ModuleType) -> None:
    ids = anchors(hooks.files_page())
    assert {f"ablation-{file.stem}" for file in (ROOT / "conf/ablation").glob("*.yaml")} <= ids
    assert {f"sweeps-{file.stem}" for file in (ROOT / "sweeps").glob("*.yaml")} <= ids
    assert "scene-llff-fern" in ids


def test_every_command_is_there_with_its_options(hooks: ModuleType) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    page = hooks.commands_page()
    assert all(f"\n## `{name}`\n" in page for name in project["scripts"])
    for option in ("--dry-run", "--against LABEL", "--path", "--sha256 HEX", "limits.minutes=N"):
        assert option in page


def test_every_public_name_and_every_component_is_there(hooks: ModuleType) -> None:
    api = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    assert all(f"\n::: xrgs.{name}\n" in api for name in xrgs.__all__)
    page = hooks.components_page()
    for key, entry in BUILT_IN.items():
        assert f"`{key}`" in page
        assert f"\n::: xrgs.training.components.{entry.module}.{entry.name}\n" in page


def on_page(hooks: ModuleType, name: str) -> Any:
    """A page of docs/, as mkdocs gives it to hooks."""
    source = ROOT / name
    file = SimpleNamespace(
        abs_src_path=str(source), src_uri=hooks.site_uri(source), name=source.stem
    )
    text = source.read_text(encoding="utf-8")
    return hooks.on_page_markdown(text, SimpleNamespace(file=file, meta={}), None, None)


def test_formulas_are_mathml(hooks: ModuleType) -> None:
    formulas = re.findall(r"\$\$(.*?)\$\$", on_page(hooks, "docs/rasterizer.md"), re.DOTALL)
    content = "\n".join(
        f'<div class="arithmatex">\\[{html.escape(formula)}\\]</div>' for formula in formulas
    )
    made = hooks.on_page_content(content, None, None, None)
    elements = set(re.findall(r"<(\w+)", made))
    assert {"math", "msqrt", "mfrac", "mtable"} <= elements
    assert "<span>(32)</span>" in made
    assert r"\bar" not in made


def test_links_lead_to_the_places_of_the_files_of_the_repository(hooks: ModuleType) -> None:
    """README.md is the home page; notes of studies are part of the site."""
    page = on_page(hooks, "README.md")
    assert "](reports/rivals/NOTES.md)" in page
    assert re.search(r"\]\(\S*start\.md#your-photographs\)", page)
    assert re.search(r"\]\(conf/config\.md(#\S+)?\)", on_page(hooks, "docs/study.md"))


def test_every_study_is_in_the_navigation() -> None:
    studies = {str(file.relative_to(ROOT)) for file in ROOT.glob("reports/*/NOTES.md")}
    listed = set(re.findall(r"reports/\w+/NOTES\.md", (ROOT / "mkdocs.yml").read_text("utf-8")))
    assert listed == studies
