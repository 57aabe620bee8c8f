"""Explains keys of the config by the comments of `conf/config.yaml`, for `xrgs-sweep help=KEY`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs import config
from xrgs.errors import XrgsError, did_you_mean
from xrgs.safeio.records import read_file

if TYPE_CHECKING:
    from collections.abc import Iterator

_WHERE = (
    "Values are those of the baseline. A preset, a scene, a variant or an ablation may set\n"
    "others; xrgs-sweep --cfg job prints the values in effect."
)


def explain(key: str) -> str:
    """Return a key's value in the baseline and its comment; of a group those of all keys in it.

    Args:
        key: A key as it stands before `=` on the command line, or the beginning of several: `train`
            for `train.steps` and others.

    Raises:
        XrgsError: There is no such key; the message offers those that are like it.
    """
    known = dict(_commented())
    found = [name for name in known if name == key or name.startswith(f"{key}.")]
    if not found:
        raise XrgsError(f"help={key}: there is no such key{did_you_mean(key, known)}")
    return "\n\n".join([*(known[name] for name in found), _WHERE])


def _commented() -> Iterator[tuple[str, str]]:
    """Yield each key of `conf/config.yaml` with its value and its comments, as one text.

    A comment stands above its key, or behind its value. Of YAML only what the file uses is read:
    mappings by indentation.
    """
    text = read_file(config.CONF_DIR / "config.yaml").decode()
    parents: list[tuple[int, str]] = []
    above: list[str] = []
    for line in text.partition("\ndefaults:")[2].splitlines():
        content = line.strip()
        if content.startswith("#"):
            above.append(content.lstrip("# "))
            continue
        name, colon, rest = content.partition(":")
        if not colon or name.startswith("-"):
            above = []
            continue
        indent = len(line) - len(line.lstrip())
        parents = [*(parent for parent in parents if parent[0] < indent), (indent, name)]
        value, _, behind = rest.partition("#")
        comment = [*above, *filter(None, [behind.strip()])]
        key = ".".join(part for _, part in parents)
        yield key, "\n".join([f"{key}={value.strip()}", *(f"  {part}" for part in comment)])
        above = []
