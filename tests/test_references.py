"""Every citation in the code and the documents is in the bibliography, and the other way round."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BIBLIOGRAPHY = ROOT / "docs" / "references.bib"
#: Folders and files that cite; a citation is a key in brackets, like [kerbl2023].
CITING = ("xrgs", "conf", "docs", "examples", "README.md", "CONTRIBUTING.md")
_KEY = r"[a-z]+\d{4}[a-z]*"


def bibliography() -> set[str]:
    keys = re.findall(r"^@\w+\{(\S+),$", BIBLIOGRAPHY.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(keys) == len(set(keys))
    return set(keys)


def citations() -> dict[str, set[str]]:
    """The keys that each file cites, by its path in the repository."""
    suffixes = {".py", ".cpp", ".h", ".yaml", ".md", ".ipynb"}
    roots = [ROOT / name for name in CITING]
    files = [file for root in roots for file in ([root] if root.is_file() else root.rglob("*"))]
    return {
        file.relative_to(ROOT).as_posix(): set(
            re.findall(rf"\[({_KEY})[\],]", file.read_text(encoding="utf-8"))
        )
        for file in files
        if file.suffix in suffixes
    }


def test_every_citation_is_in_the_bibliography() -> None:
    keys = bibliography()
    unknown = {file: missing for file, cited in citations().items() if (missing := cited - keys)}
    assert not unknown
