"""The errors that a user can fix: a command prints their message alone, without a traceback."""

from __future__ import annotations

import difflib
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

#: The most names that are offered in place of one that does not exist.
_MAX_OFFERED = 3


class XrgsError(Exception):
    """Something outside the program is wrong; the message names the file, key or parameter.

    Examples:
        >>> try:
        ...     load_gaussians("missing.ply")
        ... except XrgsError as error:
        ...     print(error)
        missing.ply: cannot be read: No such file or directory
    """


class StoreError(XrgsError):
    """A store can't be used, or one of its files is missing, damaged or not what it should be."""


class UnreadableError(StoreError):
    """A file can't be read now, because of its permissions or because a disk or a server fails.

    Nothing is known of its content: it is neither missing nor damaged, and is to be read again.
    """


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about a name that does not exist: names that are like it.

    A name is like another one whose last part is the same as its own (`fern` and `llff/fern`,
    `steps` and `train.steps`) or has nearly the same letters; if there is none, like one that has
    nearly the same letters in all.

    Args:
        name: The name that does not exist.
        known: The names that exist, whose parts a dot or a slash separates.

    Returns:
        `; did you mean A or B?`, or an empty text where no name is like it.
    """
    parts = {full: _last(full) for full in known}
    own = _last(name)
    similar = difflib.get_close_matches(own, parts.values(), cutoff=0.75)
    found = [full for last in (own, *similar) for full in parts if parts[full] == last]
    found = found or difflib.get_close_matches(name, parts)
    offered = list(dict.fromkeys(found))[:_MAX_OFFERED]
    return f"; did you mean {' or '.join(offered)}?" if offered else ""


def _last(name: str) -> str:
    return re.split(r"[./]", name)[-1]
