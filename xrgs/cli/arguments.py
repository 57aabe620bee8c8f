"""What the commands share: parsing of arguments, paths with any character, and error messages."""

from __future__ import annotations

import re
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

import xrgs
from xrgs import config
from xrgs.config import escape_interpolations
from xrgs.errors import XrgsError, did_you_mean
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

#: How Hydra says that a key of an override is unknown.
_NOT_OVERRIDDEN = re.compile(r"Could not override '([^']+)'")
#: Keys whose values are paths.
_PATHS = frozenset({"scene.path", "store", "data_root"})


@contextmanager
def errors_as_messages(command: str, hint: str = "") -> Iterator[None]:
    """End the command with a message and code 1 on errors that the user can correct.

    Args:
        command: Name of the command, which begins the message.
        hint: Added to the message about an invalid argument.

    Raises:
        SystemExit: With the message, in place of the error.
    """
    try:
        yield
    except XrgsError as error:
        sys.exit(for_line(f"{command}: {error}"))
    except (OmegaConfBaseException, HydraException) as error:
        sys.exit(for_line(f"{command}: {_explained(error)}{hint}"))


def _explained(error: Exception) -> str:
    """Return what an error of Hydra or OmegaConf says, with names like one that does not exist.

    Hydra's own advice is left out: `steps=100` would be told to become `+steps=100`, which adds a
    key that nothing reads.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing_file(error.missing_cfg_file, error.options or ())
    if isinstance(error, OverrideParseException):
        return f"{error.override}: {config.error_line(error)}"
    if found := _NOT_OVERRIDDEN.search(str(error)):
        key = found[1].partition("@")[0]
        return f"{key}: there is no such key{did_you_mean(key, config.known_keys())}"
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        parent = error.parent_node
        known = tuple(map(str, parent)) if isinstance(parent, DictConfig) else ()
        return config.error_line(error) + did_you_mean(str(error.key), known)
    if isinstance(error.__cause__, OmegaConfBaseException):  # it names the key and the value
        return _explained(error.__cause__)
    return config.error_line(error)


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
    exists = user_path(value).exists()
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


def dotlist(words: Sequence[str]) -> DictConfig:
    """Return `KEY=VALUE` words as a config whose values are the texts as they are written.

    Args:
        words: Arguments of the command line; merging them into a schema converts the texts.
    """
    conf = OmegaConf.create({})
    for word in words:
        key, _, value = word.partition("=")
        text: Any = escape_interpolations(value)
        OmegaConf.update(conf, key, text)
    return conf


def files(group: str) -> list[str]:
    """Return the names of a config group's files, sorted; empty where there is no such group.

    Args:
        group: Name of the group's folder, as `scene`.
    """
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    names = (file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml"))
    return sorted(name.as_posix() for name in names)


def choices(group: str) -> str:
    """Return the names of a config group's files, for a command's help: `fern, flower`.

    Args:
        group: Name of the group's folder.
    """
    return ", ".join(files(group))


def answer_version(command: str) -> None:
    """Print the version of xrgs and end the command, where `--version` is asked for.

    Args:
        command: Name of the command.

    Raises:
        SystemExit: With code 0, after the version was printed.
    """
    if "--version" in sys.argv[1:]:
        say(f"{command} {xrgs.__version__}")
        sys.exit()


def completion(command: str, words: Sequence[str]) -> str:
    """Return the line of bash that completes the words of a command, and names of files.

    Args:
        command: Name of the command.
        words: What may be written behind it; none of them holds a space or a quote.
    """
    return f"complete -o default -o nospace -W '{' '.join(words)}' {command}"


def parse(schema: type[Any], help_text: str) -> DictConfig:
    """Return the command line as a config of a schema, or print what it asks for and end.

    `--help`, `--version` and `--completion` ask for the help, the version and a line of bash.

    Args:
        schema: A dataclass of the arguments, with their default values.
        help_text: What `--help` prints.

    Raises:
        OmegaConfBaseException: An argument is not in the schema, or its value is of another type.
        SystemExit: With code 0, after the help, the version or the completion was printed.
    """
    command = help_text.split(maxsplit=1)[0]
    answer_version(command)
    if {"-h", "--help"} & set(sys.argv[1:]):
        say(help_text.rstrip())
        sys.exit()
    if "--completion" in sys.argv[1:]:
        say(completion(command, [f"{name}=" for name in schema.__dataclass_fields__]))
        sys.exit()
    return cast("DictConfig", OmegaConf.merge(OmegaConf.structured(schema), dotlist(sys.argv[1:])))
