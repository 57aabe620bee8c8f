"""`xrgs-sweep help=KEY`: explains keys by the comments of `conf/config.yaml`."""

from __future__ import annotations

import re

from xrgs import config
from xrgs.errors import XrgsError, did_you_mean
from xrgs.safeio.records import read_file

_COMMENT = re.compile(r" *# (.*)")
_KEY = re.compile(r"( *)(\w+):(.*?)(?:  # (.*))?")
_WHERE = (
    "Values are those of the baseline. A preset, a scene, a variant or an ablation may set\n"
    "others; xrgs-sweep --cfg job prints the values in effect."
)


def explain(key: str) -> str:
    """Return a key's value in the baseline and its comment; of a group also those of its keys.

    Args:
        key: A key as it stands before `=` on the command line, as `train.steps` or `train`.

    Raises:
        XrgsError: There is no such key; the message offers similar ones.
    """
    texts = _texts()
    found = [text for name, text in texts.items() if f"{name}.".startswith(f"{key}.")]
    if not found:
        raise XrgsError(f"help={key}: there is no such key{did_you_mean(key, texts)}")
    return "\n\n".join([*found, _WHERE])


def _texts() -> dict[str, str]:
    """Return what `conf/config.yaml` says of each key: its value, and the comment above or behind.

    Of YAML only what the file uses is read: a key with its value on one line, and two more spaces
    before each key of a group.
    """
    texts: dict[str, str] = {}
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
            first = f"{key}={value.strip()}" if value.strip() else key
            texts[key] = "\n  ".join([first, *above, *([behind] if behind else [])])
        above = []
    return texts
