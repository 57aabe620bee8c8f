"""The errors that a user can fix: commands print only the message, without a traceback."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

#: Largest number of suggested names.
_MAX_OFFERED = 3


class XrgsError(Exception):
    """An error in a file, a key or a parameter, which the message names.

    Examples:
        >>> try:
        ...     load_gaussians("missing.ply")
        ... except XrgsError as error:
        ...     print(error)
        missing.ply: cannot be read: No such file or directory
    """


class StoreError(XrgsError):
    """A store can't be used, or one of its files is missing, damaged or of the wrong content."""


class UnreadableError(StoreError):
    """A file can't be read at the moment, because of permissions or a failing disk or server.

    The file is neither missing nor known to be damaged: reading it again later may work.
    """


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of an error message about an unknown name: suggestions of similar names.

    Names are similar if their last parts are equal (`fern` and `llff/fern`, `steps` and
    `train.steps`) or nearly equal. If no last part is similar, whole names are compared.

    Args:
        name: The unknown name.
        known: The existing names, with parts separated by a dot or a slash.

    Returns:
        `; did you mean A or B?`, or an empty text if no name is similar.
    """
    parts = {full: _last(full) for full in known}
    last = _last(name)
    similar = difflib.get_close_matches(last, parts.values(), cutoff=0.75)
    names = [full for part in (last, *similar) for full in parts if parts[full] == part]
    names = names or difflib.get_close_matches(name, parts)
    offered = list(dict.fromkeys(names))[:_MAX_OFFERED]
    return f"; did you mean {' or '.join(offered)}?" if offered else ""


def _last(name: str) -> str:
    return re.split(r"[./]", name)[-1]
