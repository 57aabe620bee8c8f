"""What the commands share: parsing of arguments, paths with any character, and error messages."""

from __future__ import annotations

import sys
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.capture.scenes.folder import ALL_BELOW
from xrgs.config import escape_interpolations
from xrgs.errors import XrgsError
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

#: Keys whose values are paths.
_PATHS = frozenset({"scene.path", "store", "data_root", "variant.poses"})


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
        sys.exit(for_line(f"{command}: {config.error_line(error)}{hint}"))


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


def choices(group: str) -> str:
    """Return the names of a config group's files, for a command's help: `fern, flower`.

    Args:
        group: Name of the group's folder.
    """
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    files = sorted(folder.rglob("*.yaml"))
    return ", ".join(file.relative_to(folder).with_suffix("").as_posix() for file in files)


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
    """Return the command line as a config of a schema, or print the help and end the command.

    Args:
        schema: A dataclass of the arguments, with their default values.
        help_text: What `--help` prints.
        arguments: What to read in place of the whole command line, where that begins with the name
            of a subcommand.

    Raises:
        OmegaConfBaseException: An argument is not in the schema, or its value is of another type.
        SystemExit: With code 0, after the help was printed.
    """
    words = sys.argv[1:] if arguments is None else arguments
    help_if_asked(help_text, words)
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
    help_if_asked(help_text, sys.argv[1:] or ["--help"])
    words = [argument for argument in given if "=" not in argument]
    return words, parse(schema, help_text, [key for key in given if "=" in key])


def help_if_asked(help_text: str, arguments: Sequence[str]) -> None:
    """Print the help and end the command if a command line asks for it.

    Args:
        help_text: The help.
        arguments: The command line.

    Raises:
        SystemExit: With code 0, after the help was printed.
    """
    if {"-h", "--help"} & set(arguments):
        say(help_text.rstrip())
        sys.exit()
