"""`xrgs-sweep help=KEY`: explains a key by its comment in `conf/config.yaml`."""

from __future__ import annotations

import re
from typing import NamedTuple

from xrgs import config
from xrgs.errors import XrgsError, did_you_mean
from xrgs.safeio.records import read_file

_COMMENT = re.compile(r" *# (.*)")
_KEY = re.compile(r"( *)(\w+):(.*?)(?:  # (.*))?")
_WHERE = (
    "Values are those of the baseline. A preset, a scene, a variant or an ablation may set\n"
    "others; xrgs-sweep --cfg job prints the values in effect."
)


class Entry(NamedTuple):
    """A key of `conf/config.yaml`."""

    value: str
    """The value in the baseline, as written; empty for a group of keys."""
    comment: tuple[str, ...]
    """The lines of the comments above and behind the key."""


def explain(key: str) -> str:
    """Return a key's value in the baseline and its comment; for a group, also those of its keys.

    Raises:
        XrgsError: There is no such key; the message offers similar ones.
    """
    keys = entries()
    lines = [
        "\n  ".join([f"{name}={entry.value}" if entry.value else name, *entry.comment])
        for name, entry in keys.items()
        if f"{name}.".startswith(f"{key}.")
    ]
    if not lines:
        raise XrgsError(f"help={key}: there is no such key{did_you_mean(key, keys)}")
    return "\n\n".join([*lines, _WHERE])


def entries() -> dict[str, Entry]:
    """Read the entries of `conf/config.yaml`, keys and groups of keys, in its order.

    Only the YAML of this file is understood: a key with its value on one line, and two more spaces
    of indent for the keys of a group.
    """
    result: dict[str, Entry] = {}
    path: list[str] = []
    above: list[str] = []
    content = read_file(config.CONF_DIR / "config.yaml").decode()
    for line in content.partition("\ndefaults:")[2].splitlines():
        if comment := _COMMENT.fullmatch(line):
            above.append(comment[1])
            continue
        if entry := _KEY.fullmatch(line):
            indent, name, value, behind = entry.groups()
            path = [*path[: len(indent) // 2], name]
            key = ".".join(path)
            result[key] = Entry(value.strip(), (*above, *([behind] if behind else [])))
        above = []
    return result
