"""Hydra's overrides on a command line: paths with any character, and messages about wrong ones."""

from __future__ import annotations

import re
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from xrgs import composing, config
from xrgs.capture.scenes.scene import ALL_BELOW
from xrgs.composing import escape_interpolations
from xrgs.errors import XrgsError, did_you_mean
from xrgs.safeio.paths import user_path

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

#: How Hydra says that a key of an override is unknown.
_NOT_OVERRIDDEN = re.compile(r"Could not override '([^']+)'")
#: Keys whose values are paths.
_PATHS = frozenset({"scene.path", "store", "data_root", "variant.poses", "scene.masks"})


@contextmanager
def explained(hint: str = "") -> Iterator[None]:
    """Raise errors of Hydra and OmegaConf as one-line errors that say what was meant.

    Args:
        hint: Added to the message.

    Raises:
        XrgsError: In place of the error.
    """
    try:
        yield
    except (OmegaConfBaseException, HydraException) as error:
        raise XrgsError(f"{_explained(error)}{hint}") from error


def _explained(error: Exception) -> str:
    """Return what an error of Hydra or OmegaConf says, with names like one that does not exist.

    Hydra's own advice is left out: `steps=100` would be told to become `+steps=100`, which adds a
    key that nothing reads.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing_file(error.missing_cfg_file, error.options or ())
    if isinstance(error, OverrideParseException):
        return f"{error.override}: {composing.error_line(error)}"
    if found := _NOT_OVERRIDDEN.search(str(error)):
        key = found[1].partition("@")[0]
        return f"{key}: there is no such key{did_you_mean(key, config.known_keys())}"
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        parent = error.parent_node
        known = tuple(map(str, parent)) if isinstance(parent, DictConfig) else ()
        return composing.error_line(error) + did_you_mean(str(error.key), known)
    if isinstance(error.__cause__, OmegaConfBaseException):  # it names the key and the value
        return _explained(error.__cause__)
    return composing.error_line(error)


def _missing_file(file: str, options: Sequence[str]) -> str:
    """Return what is said of `GROUP/NAME` where there is no such file of the config."""
    group = next((g for g in config.GROUPS if file.startswith(f"{g}/")), file.rpartition("/")[0])
    name = file.removeprefix(f"{group}/")
    if not (known := sorted({*files(group), *options})):
        return f"{group}: there is no such key{did_you_mean(group, config.known_keys())}"
    offered = did_you_mean(name, known) or f"; choose from: {', '.join(known)}"
    return f"{group}={name}: there is no such choice{offered}"


def with_quotes(words: Sequence[str]) -> list[str]:
    """Return Hydra overrides, with quotes around paths that Hydra's grammar would refuse or change.

    Paths that Hydra reads as they are written, or that are in quotes already, stay unchanged.
    Commas in `scene.path` separate scenes, unless there is a folder of that name; a sweep has one
    store, so that commas in `store` are part of the path.

    Args:
        words: Arguments of the command line.

    Raises:
        XrgsError: A word is not valid Unicode, and no file could be written with it.
    """
    for word in words:
        if not word.isascii() and word.encode(errors="replace").decode() != word:
            raise XrgsError(f"{word!r} has bytes that are not valid Unicode; rename the file")
    return [_with_quotes(word) for word in words]


def _with_quotes(word: str) -> str:
    key, _, value = word.partition("=")
    if key not in _PATHS or not value or value[0] in "'\"":
        return word
    exists = user_path(value.removesuffix(ALL_BELOW)).exists()
    if exists or key != "scene.path":
        return f"{key}={_quoted(key, escape_interpolations(value) if exists else value)}"
    return f"{key}={','.join(_quoted(key, part) for part in value.split(','))}"


def _quoted(key: str, value: str) -> str:
    """Return a path in quotes, or as it is if Hydra reads it as it is written."""
    with suppress(HydraException):
        (override,) = OverridesParser.create().parse_overrides([f"{key}={value}"])
        parsed = override.value()
        if parsed == value and not override.is_sweep_override():
            return value
        if (parsed is None or "\\" in value) and not user_path(value).exists():
            return value
    return QuotedString(value, Quote.single).with_quotes()


def files(group: str) -> list[str]:
    """Return the names of a config group's files, sorted; empty where there is no such group.

    Args:
        group: Name of the group's folder, as `scene`.
    """
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    names = (file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml"))
    return sorted(name.as_posix() for name in names)
