"""What the commands share: parsing of arguments, paths with any character, and error messages."""

from __future__ import annotations

import re
import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

import xrgs
from xrgs import composing, config
from xrgs.capture.scenes.scene import ALL_BELOW
from xrgs.composing import escape_interpolations
from xrgs.errors import XrgsError, did_you_mean
from xrgs.runtime.streams import ignore_broken_pipe, say
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

#: How Hydra says that a key of an override is unknown.
_NOT_OVERRIDDEN = re.compile(r"Could not override '([^']+)'")
#: Keys whose values are paths.
_PATHS = frozenset({"scene.path", "store", "data_root", "variant.poses"})


@contextmanager
def errors_as_messages(command: str, hint: str = "") -> Iterator[None]:
    """End the command with a message and code 1 on errors that the user can correct.

    A reader of its output that ends first, as `head` does, is no error.

    Args:
        command: Name of the command, which begins the message.
        hint: Added to the message about an invalid argument.

    Raises:
        SystemExit: With the message, in place of the error.
    """
    ignore_broken_pipe()
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


def names_in(text: str) -> tuple[str, ...]:
    """Return the names in a value such as `fern,flower`, in their order; none of an empty one.

    Args:
        text: Names separated by commas.
    """
    return tuple(name for name in text.split(",") if name)


def paths_in(text: str) -> list[Path]:
    """Return the folders in a value such as `a,b`.

    Args:
        text: Folders separated by commas; a folder whose own name has a comma is one, if it exists.
    """
    return [Path(text)] if user_path(text).exists() else [*map(Path, names_in(text) or [text])]


def parse(schema: type[Any], help_text: str, arguments: Sequence[str] | None = None) -> DictConfig:
    """Return the command line as a config of a schema, or print what it asks for and end.

    `--help`, `--version` and `--completion` ask for the help, the version and a line of bash.

    Args:
        schema: A dataclass of the arguments, with their default values.
        help_text: What `--help` prints.
        arguments: What to read in place of the whole command line, where that begins with the name
            of a subcommand.

    Raises:
        OmegaConfBaseException: An argument is not in the schema, or its value is of another type.
        SystemExit: With code 0, after the help, the version or the completion was printed.
    """
    words = sys.argv[1:] if arguments is None else arguments
    answer(schema, help_text, words)
    return cast("DictConfig", OmegaConf.merge(OmegaConf.structured(schema), dotlist(words)))


def parse_with_words(
    schema: type[Any], help_text: str, arguments: Sequence[str] | None = None
) -> tuple[list[str], DictConfig]:
    """Return the words of a command line that have no `=`, and the others as `parse` does.

    Args:
        schema: As for `parse`.
        help_text: As for `parse`.
        arguments: As for `parse`.

    Raises:
        OmegaConfBaseException: As `parse`.
        SystemExit: As `parse`, also where the command line has no argument at all.
    """
    given = sys.argv[1:] if arguments is None else arguments
    answer(schema, help_text, sys.argv[1:] or ["--help"])
    words = [argument for argument in given if "=" not in argument]
    return words, parse(schema, help_text, [key for key in given if "=" in key])


def answer(schema: type[Any], help_text: str, arguments: Sequence[str]) -> None:
    """Print the help, the version or a line of bash and end, if a command line asks for one.

    Args:
        schema: A dataclass of the arguments, whose names are completed.
        help_text: The help, which begins with the name of the command.
        arguments: The command line.

    Raises:
        SystemExit: With code 0, after it was printed.
    """
    command = help_text.split(maxsplit=1)[0]
    answer_version(command)
    if {"-h", "--help"} & set(arguments):
        say(help_text.rstrip())
        sys.exit()
    if "--completion" in arguments:
        say(completion(command, [f"{name}=" for name in schema.__dataclass_fields__]))
        sys.exit()
