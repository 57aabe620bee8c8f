"""Options of all commands except `xrgs-sweep`, by tyro, and errors as messages.

tyro makes help, completion and messages about wrong usage from typed functions and their
docstrings. `xrgs-sweep` takes Hydra's overrides instead, see `overrides`.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_type_hints

import tyro
from tyro.conf import (
    CascadeSubcommandArgs,
    DisallowNone,
    FlagCreatePairsOff,
    OmitArgPrefixes,
    Positional,
    arg,
)
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

import xrgs
from xrgs.config import known_keys
from xrgs.errors import XrgsError
from xrgs.runtime.machine import end_quickly
from xrgs.runtime.signals import exit_on_signal
from xrgs.runtime.streams import guard_streams, say
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line
from xrgs.store.store import DEFAULT_STORE

STORE = DEFAULT_STORE


def shown_as(metavar: str) -> object:
    """Annotate an option: the help shows `metavar` for its value, and no default."""
    return arg(metavar=metavar, help_behavior_hint="")


Cells: TypeAlias = Annotated[tuple[str, ...], shown_as("CELL ...")]
Flag: TypeAlias = Annotated[bool, arg(help_behavior_hint="")]
Folder: TypeAlias = Annotated[Path, arg(metavar="FOLDER")]
Names: TypeAlias = Annotated[tuple[str, ...], shown_as("NAME ...")]
OptionalFolder: TypeAlias = Annotated[Path | None, shown_as("FOLDER")]

_CONFIG = (
    CascadeSubcommandArgs,  # options without a subcommand belong to the default one
    DisallowNone,  # no word "None" for an option that was not given
    FlagCreatePairsOff,  # no --no-dry-run beside --dry-run
    OmitArgPrefixes,  # --scenes, not --which.scenes, for an option in a dataclass
)
_REGISTRY = ConstructorRegistry()


@_REGISTRY.primitive_rule
def _word(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Read a text, or a path, whose `~` shells don't expand in `--out=~/a`; none may be empty."""
    readers: dict[type, Callable[[list[str]], Any]] = {Path: _given_path, str: _given_text}
    if kind.type not in readers:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH" if kind.type is Path else "TEXT",
        instance_from_str=readers[kind.type],
        is_instance=lambda value: isinstance(value, kind.type),
        str_from_instance=lambda value: [str(value)],
    )


@_REGISTRY.primitive_rule
def _texts(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[tuple[str, ...]] | None:
    """Read the values of an option that takes any number of texts; none would mean all."""
    if kind.type != tuple[str, ...]:
        return None
    least = 0 if Positional in kind.markers else 1  # commands say themselves what they lack
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="TEXT ...",
        instance_from_str=lambda words: _given_texts(words, least),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=list,
    )


def _given_texts(words: Sequence[str], least: int = 1) -> tuple[str, ...]:
    """Return the values of an option; ValueError for fewer than `least`, or an empty one.

    A variable that is not set gives either: `xrgs-store trim --sweep $ID` would trim all cells.
    """
    if len(words) < least or "" in words:
        raise ValueError("takes a value, and none or an empty one is given")
    return tuple(words)


def _given_text(words: Sequence[str]) -> str:
    return _given_texts(words)[0]


def _given_path(words: Sequence[str]) -> Path:
    """Return the path of an option; ValueError for an empty one, as of an unset variable."""
    if not words[0]:
        raise ValueError("is empty; give a path, or leave the option out")
    return user_path(words[0])


def run(
    command: str,
    target: Callable[..., None] | Mapping[str, Callable[..., None]],
    description: str | None = None,
    default: str = "",
    overrides: str = "",
    hint: str = "Run the same command again.",
) -> None:
    """Parse the command line, and call the function of the command or subcommand.

    Args:
        command: Name of the command.
        target: A function, whose typed parameters are the options and whose docstring is the help;
            or subcommand -> such a function.
        description: The first lines of the help, for a command with subcommands.
        default: The subcommand if the command line names none.
        overrides: The subcommand that takes Hydra's overrides, `KEY=VALUE`; `command` itself if
            there are no subcommands.
        hint: Printed if a signal ends the command: what is kept, and how to go on.

    Raises:
        SystemExit: With code 1 on an `XrgsError`, with code 2 on wrong usage, and with 128 plus its
            number on a signal.
    """
    guard_streams()
    end_quickly()
    answer_version(command)
    functions = {command: target} if callable(target) else target
    names = frozenset(name for function in functions.values() for name in _names(function))
    name = "[a-z][a-z_]*"
    takes_overrides = overrides in {command, *sys.argv[1:2]} - {""}
    if takes_overrides:
        name = "|".join({*_names(functions[overrides])} - {*known_keys()})
    assignment = re.compile(f"({name})=(.*)", re.DOTALL)
    words = _with_options(sys.argv[1:], assignment, names)
    if takes_overrides:
        words = _with_overrides_last(words)
    with exit_on_signal(hint), errors_as_messages(command, assignment):
        if callable(target):
            tyro.cli(
                _unwrapped(target), prog=command, args=words, config=_CONFIG, registry=_REGISTRY
            )
            return
        app = tyro.extras.SubcommandApp()
        for name, function in target.items():
            app.command(name=name, is_default=name == default)(_unwrapped(function))
        app.cli(
            prog=command, description=description, args=words, config=_CONFIG, registry=_REGISTRY
        )


def _unwrapped(function: Callable[..., None]) -> Callable[..., None]:
    """Join the lines of each entry under Args: tyro would keep their line breaks in the help."""
    function.__doc__ = re.sub(r"\n {8,}", " ", inspect.cleandoc(function.__doc__ or ""))
    return function


def _names(options: Any) -> Iterator[str]:
    """Yield the names of the options of a function or dataclass, including nested dataclasses."""
    for name, hint in get_type_hints(options, include_extras=True).items():
        if is_dataclass(hint):
            yield from _names(hint)
        given = (getattr(mark, "name", None) for mark in getattr(hint, "__metadata__", ()))
        yield next(filter(None, given), name)


def _with_options(
    words: Sequence[str], assignment: re.Pattern[str], names: Container[str]
) -> list[str]:
    """Convert each `KEY=VALUE` of a command line, as for `xrgs-sweep`, to the option `--key VALUE`.

    `true` sets a flag. Commas separate values, unless a file has that name. After an option, a word
    with an unknown key is a value, such as the scene name `a=b`.
    """
    others, options = [], []  # options come last: only another option ends a list of values
    for number, word in enumerate(words):
        match = assignment.fullmatch(word)
        is_value = match and match[1] not in names and any(w[:2] == "--" for w in words[:number])
        if not match or is_value:
            others.append(word)
            continue
        option, value = _option(match[1]), match[2]
        if value == "true":
            options.append(option)
        elif value != "false":
            is_file = os.access(user_path(value), os.F_OK)
            options += [option, *([value] if is_file else value.split(","))]
    return others + options


def _with_overrides_last(words: Sequence[str]) -> list[str]:
    """Move Hydra's overrides behind all options; tyro reads only words that stand together.

    A word `A=B` behind an option may be its value, unless `A` is a key of the config.
    """
    others, moved = list[str](), list[str]()
    for before, word in pairwise(["", *words]):
        key, is_assignment, _ = word.partition("=")
        is_key = is_assignment and (key[:1] in {"+", "~"} or key in known_keys())
        free = is_assignment and key[:1] != "-" and before[:2] != "--"
        (moved if is_key or free else others).append(word)
    return others + moved


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


@contextmanager
def errors_as_messages(command: str, argument: re.Pattern[str] | None = None) -> Iterator[None]:
    """End the command with a message and code 1 on errors that the user can correct.

    Args:
        command: Name of the command, which begins the message.
        argument: Splits a message on a function's argument, such as `out=FOLDER: it exists`, into
            name and rest. It is printed with the option's name: `--out FOLDER: it exists`.

    Raises:
        SystemExit: With the message, instead of the error.
    """
    try:
        try:
            Path.cwd()
        except OSError as error:
            raise XrgsError(
                f"the current folder can't be found ({error}): cd to another"
            ) from error
        yield
    except XrgsError as error:
        message = str(error)
        if argument and (match := argument.fullmatch(message)):
            message = f"{_option(match[1])} {match[2]}"
        sys.exit(for_line(f"{command}: {message}"))


def answer_version(command: str) -> None:
    """Print the version of xrgs and end the command, if the command line has `--version`.

    Raises:
        SystemExit: With code 0, after the version was printed.
    """
    if "--version" in sys.argv[1:]:
        say(f"{command} {xrgs.__version__}")
        sys.exit()
