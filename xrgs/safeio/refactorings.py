"""Declared refactorings: versions of a part of the code that give the same results.

`xrgs-store prove` declares them in `refactorings.json`, so that cells and variants keep their ids.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.safeio.atomic import write_json

if TYPE_CHECKING:
    from collections.abc import Iterable

#: The old digest of a part that was split off from another one; identities of before lack it.
ABSENT = ""
#: For each part of the code, old digests by the new ones that are equal.
FILE = Path(__file__).with_name("refactorings.json")

Change = tuple[str, str, str]
"""Name of a part, its old digest and its new one."""


def canonical(part: str, code: str) -> str:
    """Return the oldest digest that a refactoring has declared equal to this digest of a part."""
    of_part = declared().get(part, {})
    while code in of_part:
        code = of_part[code]
    return code


def declared() -> dict[str, dict[str, str]]:
    """Return old digests by new ones, for each part of the code."""
    if not FILE.is_file():
        return {}
    content: dict[str, dict[str, str]] = json.loads(FILE.read_text(encoding="utf-8"))
    return content


def declare(changes: Iterable[Change]) -> None:
    """Declare the new digests of parts equal to their old ones.

    Raises:
        XrgsError: The file can't be written.
    """
    content = declared()
    for part, old, new in changes:
        content.setdefault(part, {})[new] = old
    try:
        write_json(FILE, content)
    except OSError as error:
        raise XrgsError(f"{FILE}: {error.strerror}") from error
