"""The links of the documentation lead somewhere, and its lists name what there is."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import xrgs

ROOT = Path(__file__).parents[1]
#: The target of a link or a picture; those of the web and of an address are not looked at.
_LINK = re.compile(r"\]\((?!\w+:)([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
_CODE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def pages() -> list[Path]:
    folders = (ROOT, ROOT / "docs", ROOT / "examples", ROOT / "reports", ROOT / "findings")
    return [page for folder in folders for page in sorted(folder.glob("*.md"))]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = _HEADING.findall(_CODE.sub("", page.read_text(encoding="utf-8")))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    for link in _LINK.findall(_CODE.sub("", page.read_text(encoding="utf-8"))):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_pages_that_code_and_notes_name_are_there() -> None:
    """Messages, docstrings and comments send readers to pages of `docs/`."""
    folders = ("xrgs", "hydra_plugins", "tests", "conf", "sweeps", "examples", "benchmarks")
    files = [file for name in (*folders, "findings", ".ci") for file in (ROOT / name).rglob("*")]
    texts = {".py", ".h", ".cpp", ".sh", ".yaml", ".md", ".toml", ""}
    named = {
        page
        for file in [*files, *ROOT.glob("*.*")]
        if file.is_file() and file.suffix in texts and file.name != "CHANGELOG.md"
        for page in re.findall(r"\bdocs/\w+\.md\b", file.read_text(encoding="utf-8"))
    }
    assert "docs/your_photographs.md" in named
    assert named <= {f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")}


def test_the_tree_of_the_readme_has_every_page_and_every_package() -> None:
    tree = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Files\n\n```\n")[2]
    parts = re.split(r"^(\w+)/", tree.partition("```")[0], flags=re.MULTILINE)
    inside = dict(zip(parts[1::2], parts[2::2], strict=True))
    assert all((ROOT / folder).is_dir() for folder in inside)
    listed = re.findall(r"^  (\w+(?:, \w+)*)  ", inside["docs"], re.MULTILINE)
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")}
    assert sorted(", ".join(listed).split(", ")) == sorted(pages)
    packages = re.findall(r"^  (\w+)/  ", inside["xrgs"], re.MULTILINE)
    folders = {path.name for path in (ROOT / "xrgs").iterdir() if path.is_dir()}
    assert sorted(packages) == sorted(folders - {"__pycache__"})


def test_the_findings_are_listed_and_run() -> None:
    scripts = sorted((ROOT / "findings").glob("*.sh"))
    listed = re.findall(
        r"^\| \[(\w+)\]\(\1\.sh\)", (ROOT / "findings/README.md").read_text(), re.MULTILINE
    )
    assert listed == [script.stem for script in scripts]
    assert all(os.access(script, os.X_OK) for script in scripts)


def test_the_tested_versions_are_those_that_are_allowed() -> None:
    table = re.findall(
        r"^\| ([\w-]+) \| ([\d.]+) \| ([\d.]+) \|",
        (ROOT / "CONTRIBUTING.md").read_text(),
        re.MULTILINE,
    )
    tested = {name: versions for name, *versions in table}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    allowed = {found.name: found.specifier for found in map(Requirement, project["dependencies"])}
    assert tested.keys() == allowed.keys()
    for name, versions in tested.items():
        assert all(allowed[name].contains(version) for version in versions), name


def test_the_site_has_every_public_name_and_every_study() -> None:
    api = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    assert all(f"\n::: xrgs.{name}\n" in api for name in xrgs.__all__)
    studies = {str(file.relative_to(ROOT)) for file in ROOT.glob("reports/*/NOTES.md")}
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert set(re.findall(r"reports/\w+/NOTES\.md", navigation)) == studies
