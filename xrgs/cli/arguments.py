"""What the commands share: their arguments, and paths with any character in them."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from xrgs import config
from xrgs.config import literal
from xrgs.errors import XrgsError
from xrgs.safeio.atomic import path_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_PATHS = frozenset({"scene.path", "store", "data_root"})


def with_quotes(words: Sequence[str]) -> list[str]:
    """Hydra's overrides, paths in quotes where its grammar would refuse or change them.

    What it reads as it is written and what is in quotes already stay as they are. Commas make a
    list of scenes, unless there is a folder of that name; no sweep has two stores.

    Raises:
        XrgsError: a word is no valid Unicode, which no file could be written with.
    """
    for word in words:
        if not word.isascii() and word.encode(errors="replace").decode() != word:
            raise XrgsError(f"{word!r}: bytes that are no Unicode; rename it")
    return [_with_quotes(word) for word in words]


def _with_quotes(word: str) -> str:
    key, _, value = word.partition("=")
    if key not in _PATHS or not value or value[0] in "'\"":
        return word
    there = path_of(value).exists()
    if there or key != "scene.path":
        return f"{key}={_one(key, literal(value) if there else value)}"
    return f"{key}={','.join(_one(key, part) for part in value.split(','))}"


def _one(key: str, value: str) -> str:
    with suppress(HydraException):
        (override,) = OverridesParser.create().parse_overrides([f"{key}={value}"])
        found = override.value()
        if found == value and not override.is_sweep_override():
            return value
        if (found is None or "\\" in value) and not path_of(value).exists():
            return value
    return QuotedString(value, Quote.single).with_quotes()


def dotlist(words: Sequence[str]) -> DictConfig:
    """`KEY=VALUE` words as a config: the values as they are written, for a schema to convert."""
    conf = OmegaConf.create({})
    for word in words:
        key, _, value = word.partition("=")
        found: Any = literal(value)
        OmegaConf.update(conf, key, found)
    return conf


def choices(group: str) -> str:
    """The names of a config group's files, for a command's help: `fern, flower`."""
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    files = sorted(folder.rglob("*.yaml"))
    return ", ".join(file.relative_to(folder).with_suffix("").as_posix() for file in files)


def parse(schema: type[Any], command: Callable[[], None]) -> DictConfig:
    """What the command line gives; where it asks for help, that is printed and all there is.

    Raises:
        OmegaConfBaseException: a key that the schema has not, or a value of another type.
    """
    known = OmegaConf.structured(schema)
    if {"-h", "--help"} & set(sys.argv[1:]):
        usage = (command.__doc__ or "").replace("`", "")
        print(f"{usage}\n\n{OmegaConf.to_yaml(known)}", end="")  # noqa: T201
        sys.exit()
    return cast("DictConfig", OmegaConf.merge(known, dotlist(sys.argv[1:])))
