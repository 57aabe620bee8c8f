"""Declared refactorings: versions of a part of the code that give the same results.

`.ci/prove` declares them in `refactorings.json`, so that cells and variants keep their ids.
"""

from __future__ import annotations

import json
from pathlib import Path

#: The old digest of a part that was split off from another one: older identities lack the part.
ABSENT = ""
#: For each part of the code: new digest -> the old digest that it is declared equal to.
FILE = Path(__file__).with_name("refactorings.json")


def canonical(part: str, code: str) -> str:
    """Return the oldest digest that a refactoring has declared equal to this digest of a part."""
    older = declared().get(part, {})
    while code in older:
        code = older[code]
    return code


def declared() -> dict[str, dict[str, str]]:
    """Return the content of `FILE`; nothing where it is not there."""
    if not FILE.is_file():
        return {}
    content: dict[str, dict[str, str]] = json.loads(FILE.read_text(encoding="utf-8"))
    return content
