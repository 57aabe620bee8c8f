"""Hydra's overrides on a command line: quotes for paths, and one-line messages for mistakes."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from decimal import Decimal
from itertools import accumulate, pairwise
from traceback import walk_tb
from typing import Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from xrgs import composing, config
from xrgs.composing import escape_interpolations
from xrgs.errors import XrgsError, did_you_mean
from xrgs.photos.scenes.scene import ALL_BELOW
from xrgs.safeio.paths import user_path
from xrgs.sweep.axes import as_name

#: Hydra's message if a file of the config can't be merged into the others.
_IN_FILE = re.compile(r"In '([^']+)': \w+ raised while composing config:\n")
#: OmegaConf's message if something else than keys is given for a key that has keys of its own.
_NOT_MERGED = re.compile(
    r"Merge error: \w+ is not a subclass of (?P<type>\w+)\. value: (?P<value>.*)"
)
#: Hydra's message for an unknown key of an override.
_NOT_OVERRIDDEN = re.compile(r"Could not override '([^']+)'")
#: A quoted text, and a quoted text that is a whole item of a list.
_IN_QUOTES = r"""(['"])(?:\\.|(?!\1).)*\1"""
_QUOTED, _QUOTED_PART = (
    re.compile(_IN_QUOTES),
    re.compile(rf"(?:^|(?<=[\[,]))\s*{_IN_QUOTES}(?=\s*(?:[\],]|$))"),
)
#: Bracket -> the change of the nesting depth after it.
_DEPTH = dict.fromkeys("([{", 1) | dict.fromkeys(")]}", -1)
_CLOSES = {"(": ")", "[": "]", "{": "}"}
#: Commas without a value on one side: at an end of a list, or after another comma.
_LONE_COMMA = re.compile(r"^[\s,]+|(?<=[(\[{,])[\s,]+|[\s,]+(?=[)\]}]|$)")
#: Hydra's message if a function in an override fails.
_CALL = re.compile(
    r"(?P<kind>\w+) while evaluating '(?P<call>(?P<name>\w+)\((?P<inside>.*?)\))': (?P<reason>.*)"
)
#: The key or the resolver of an interpolation `${...}`.
_INTERPOLATED = re.compile(r"\$\{([^:}]*)")
#: Options of Hydra; those in the second set take a value.
_HYDRA_OPTIONS = frozenset(
    {"-h", "--help", "--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m"}
    | {"--shell-completion", "-sc"}
)
_HYDRA_VALUES = frozenset(
    {"--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn"}
    | {"--config-dir", "-cd", "--experimental-rerun", "--info", "-i"}
)
#: Keys with the values `true` and `false`.
_FLAGS = frozenset({"dry_run", "fail_fast"})
#: The most names that a message lists.
_MAX_LISTED = 20
#: Numbers that may be whole, also as 3e3 or 100.0.
_WHOLE = re.compile(r"\d+(?:\.\d*)?(?:[eE]\+?\d{1,2})?")
_NUMBER = r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?"
#: Two numbers as people write a range, and numbers that are separated by other signs than commas.
_SPAN = re.compile(rf"({_NUMBER})\s*(?:-|–|—|:|\.\.+|\bto\b)\s*({_NUMBER})")
_SEPARATED = re.compile(rf"{_NUMBER}(?:(?:\s*[;|]\s*|\s+){_NUMBER})+")
#: The most values that a message lists in the place of a range.
_FEW = 20
#: Keys whose values are lists of names.
_NAMES = frozenset({"variant.test"})
#: Options of Hydra whose value is a folder, and the option whose value may be left out.
_FOLDERS = frozenset({"--config-dir", "-cd", "--config-path", "-cp"})
_INFO = frozenset({"--info", "-i"})
#: Options and keys that make Hydra do something else than a sweep.
_OTHER_MODES = _INFO | {
    *("--cfg", "-c", "--run", "-r", "hydra.mode", "--hydra-help", "--shell-completion", "-sc")
}


@contextmanager
def explained(hint: str = "") -> Iterator[None]:
    """Turn errors of Hydra and OmegaConf into one-line errors that propose a correction.

    Raises:
        XrgsError: Instead of the error.
    """
    try:
        yield
    except (OmegaConfBaseException, HydraException) as error:
        raise XrgsError(f"{_explained(error)}{hint}") from error
    except YAMLError as error:  # it names the file
        raise XrgsError(f"a YAML file of the config can't be read: {error}") from error
    except UnicodeDecodeError as error:
        file = _file_read(error) or "a YAML file of the config"
        raise XrgsError(f"{file}: is not in UTF-8, which YAML files must be: {error}") from error
    except OSError as error:
        if not (file := _file_read(error)):
            raise
        reason = error.strerror or "must have lines KEY: VALUE"  # OmegaConf's own has no number
        raise XrgsError(f"{file}: {reason}") from error


def _file_read(error: Exception) -> str:
    """Return the file that Hydra was reading when an error was raised; empty if it was none.

    The error itself does not know it.
    """
    calls = (frame for frame, _ in walk_tb(error.__traceback__))
    reading = (call.f_locals for call in calls if call.f_code.co_name == "load_config")
    return next((str(local["full_path"]) for local in reading if "full_path" in local), "")


def _explained(error: Exception) -> str:
    """Return the message of an error of Hydra or OmegaConf, with names similar to an unknown one.

    Hydra's own advice is left out: for `steps=100` it proposes `+steps=100`, which adds a key that
    nothing reads.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing_file(error.missing_cfg_file, error.options or ())
    if isinstance(error, OverrideParseException):
        return _malformed(str(error.override), str(error))
    if match := _IN_FILE.match(str(error)):
        return _wrong_file(match[1], error.__context__ or error)
    if match := _NOT_OVERRIDDEN.search(str(error)):
        key = match[1].partition("@")[0]
        inner = str(getattr(error.__cause__, "full_key", ""))
        if inner.startswith(f"{key}."):  # of train={stepz:5}
            key = inner
        why = f"there is no such key{did_you_mean(key, config.known_keys())}"
        if key.startswith("components.plugins."):
            why = f"a setting of another package's component has a + before it: +{key}=..."
        return f"{key}: {why}"
    offered = ""
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        parent = error.parent_node
        choices = tuple(map(str, parent)) if isinstance(parent, DictConfig) else ()
        offered = did_you_mean(str(error.key), choices)
    elif isinstance(error.__cause__, OmegaConfBaseException):  # it names the key and the value
        return _explained(error.__cause__)
    return composing.error_line(error) + offered


def _malformed(word: str, message: str) -> str:
    """Return a message with a correction of a word that Hydra's grammar refuses with a message."""
    key, equals, value = word.partition("=")
    if not equals:
        return f"{word}: write KEY=VALUE, as seed=1; one folder of photographs is taken"
    if not _parsed(f"{key}=1"):
        return f"{word}: there is no such key{did_you_mean(key.lstrip('+~'), config.known_keys())}"
    call = _CALL.search(message)
    whole, name, inside = call.group("call", "name", "inside") if call else ("", "", "")
    axis = inside if inside.endswith(")") else whole
    is_wrapped = value[:1] == "(" or "(" not in value  # and no function, as choice()
    candidates = (
        ("a comma has no value beside it", _LONE_COMMA.sub("", value)),
        ("there is one = too many", value.lstrip("=")),
        ("a bracket is not closed", value + _closing(value)),
        ("a bracket is not opened", _opened(key, value)),
        ("axes are not in brackets", value.strip("()") if is_wrapped else value),
        (f"{name}(...) takes values, and no axis", value.replace(whole, axis)),
    )
    for why, meant in candidates:
        if meant != value and _parsed(f"{key}={meant}"):
            return f"{word}: {why}; write {shlex.quote(f'{key}={meant}')}"
    if call and call["kind"] == "ValueError":
        return f"{word}: {call['reason']}"
    return (
        f"{word}: can't be read; several values are written as {key}=1,2,3 or {key}=range(1,4), and"
        f" a text with brackets, quotes or other signs in quotes, {key}='a (b)'"
    )


def _closing(text: str) -> str:
    """Return the brackets that close the open ones at the end of a text."""
    still_open: list[str] = []
    for sign in _QUOTED.sub("", text):
        if sign in _CLOSES:
            still_open.append(_CLOSES[sign])
        elif still_open and sign == still_open[-1]:
            still_open.pop()
    return "".join(reversed(still_open))


def _lacks_bracket(text: str) -> bool:
    """Return whether a text begins or ends with a bracket that has no other one."""
    depth = sum(_DEPTH.get(sign, 0) for sign in _QUOTED.sub("", text))
    return (depth > 0 and text[0] in "[(") or (depth < 0 and text[-1] in ")]")


def _opened(key: str, text: str) -> str:
    """Return a text with a bracket for the one that closes it; without that, if no list is meant.

    Only names of files of a group may be a list.
    """
    if text[-1:] != "]" or text[:1] == "[":
        return text
    return f"[{text}" if key.lstrip("+") in config.GROUPS else text[:-1]


def _wrong_file(file: str, error: BaseException) -> str:
    """Return the message on a file of the config that can't be merged into the others."""
    group = file.partition("/")[0]
    key = str(getattr(error, "full_key", ""))
    if key not in config.types_of(config.Conf) and (key == group or key.startswith("_")):
        reason = "its first line must be `# @package _global_`"
    elif "DictConfig with ListConfig" in str(error):
        reason = "is a list; it must have lines KEY: VALUE"
    elif match := _NOT_MERGED.match(str(error)):
        keys = [k for k in config.known_keys() if _type_name(k) == match["type"]]
        reason = f"{' or '.join(keys)}: takes keys of its own, and not {match['value']}"
    else:
        reason = _explained(error) if isinstance(error, Exception) else str(error)
    return f"{file}.yaml: {reason}"


def _type_name(key: str) -> str:
    return str(getattr(_type_of(key), "__name__", ""))


def _missing_file(file: str, options: Sequence[str]) -> str:
    """Return the message on a missing file `GROUP/NAME` of the config."""
    group = next((g for g in config.GROUPS if file.startswith(f"{g}/")), file.rpartition("/")[0])
    name = file.removeprefix(f"{group}/")
    if not (choices := sorted({*files(group), *options})):
        return f"{group}: there is no such key{did_you_mean(group, config.known_keys())}"
    if group == "scene" and user_path(name).is_dir():
        word = shlex.quote(f"scene.path={name}")
        return f"scene={name}: a folder of photographs is given as scene=folder {word}"
    if group == "ablation" and name in composing.ARMS:
        return (
            f"ablation={name}: it is in a package of its own: pip install ./examples/arms, and"
            " xrgs-sweep --config-dir examples/arms/conf finds it"
        )
    all_known = f"; choose from: {', '.join(choices)}"
    if len(choices) > _MAX_LISTED:
        all_known = f"; xrgs-sweep --help lists all {len(choices)}"
    offered = did_you_mean(name, choices) or all_known
    return f"{group}={name}: there is no such choice{offered}"


def with_options_first(words: Sequence[str]) -> list[str]:
    """Order a command line as Hydra's parser needs it: options first, then overrides.

    `--multirun` is added for a sweep: without it, Hydra checks axes first, and blames them for
    every other mistake.
    """
    options: list[str] = []
    overrides: list[str] = []
    remaining = list(words)
    while remaining:
        word = remaining.pop(0)
        if not word.startswith("-"):
            overrides.append(word)
            continue
        name, _, value = word.partition("=")
        if name in _HYDRA_VALUES - _INFO and not value and remaining:
            value = remaining.pop(0)
        if name in _INFO and not value:
            value = remaining.pop(0) if remaining and "=" not in remaining[0] else "all"
        if name in _FOLDERS and value:
            value = str(user_path(value))
        if name not in ("--multirun", "-m"):
            options += [name, value] if value else [name]
    other = [word for word in (*options, *overrides) if word.partition("=")[0] in _OTHER_MODES]
    if not other:
        options.append("--multirun")
    return options + overrides


def with_quotes(words: Sequence[str]) -> list[str]:
    """Put quotes around paths and names in overrides that Hydra's grammar would misread.

    Paths and names may have any character; a quoted value stays as it is. Commas in `scene.path`
    and in groups of files separate the values of an axis, unless a folder has that name. A list of
    names is `[a,b]`, or `a,b`; `[a,b],[c]` is an axis of two lists. Values of other keys stay.

    Raises:
        XrgsError: A word is not valid Unicode, gives no path, or has several numbers that are not
            an axis of Hydra's grammar; the message has the correction.
    """
    for word in words:
        if not word.isascii() and word.encode(errors="replace").decode() != word:
            raise XrgsError(f"{word!r} has bytes that are not valid Unicode; rename the file")
    return [_with_quotes(word) for word in words]


def _with_quotes(word: str) -> str:
    signed, _, value = word.partition("=")
    key = signed.lstrip("+")
    if not value and key in config.PATHS:  # as store=$STORE without the variable
        raise XrgsError(f"{word}: is empty; give a path, or leave it out")
    if not value:
        return word
    if key in _NAMES:
        quoted = _quoted_lists(value)
    elif value[0] in "'\"" and _parsed(word):
        quoted = value
    elif key in config.GROUPS and _lacks_bracket(value):
        quoted = value  # Hydra's grammar refuses it, and `explained` says which bracket is missing
    elif key in config.GROUPS:
        quoted = ",".join(_quoted_choice(key, part) for part in _parts(value))
    elif key == "scene.name":
        quoted = _quoted(key, escape_interpolations(value))
    elif key in config.PATHS:
        parts = value.split(",") if key == "scene.path" and not _exists(value) else [value]
        quoted = ",".join(_quoted_path(key, part) for part in parts)
    elif (kind := _type_of(key)) in (int, float, int | None, float | None):
        _check_numbers(signed, value, is_whole=kind in (int, int | None))
        quoted = ",".join(map(_whole, value.split(","))) if kind is int else value
    else:
        quoted = value
    return f"{signed}={quoted}"


def _type_of(key: str) -> object:
    """Return the schema's type of a key; None if it has none."""
    kind: Any = config.Conf
    for name in key.split("."):
        kind = config.types_of(cast("Any", kind)).get(name) if is_dataclass(kind) else None
    return kind


def _check_numbers(key: str, value: str, *, is_whole: bool) -> None:
    """Refuse several numbers in a notation that is not Hydra's, such as `0-3` and `0 1 2`.

    Hydra takes them for a text, and its message does not say how an axis is written.

    Raises:
        XrgsError: The message has the words to type.
    """
    inside = value[1:-1] if value[0] + value[-1] in ("[]", "()", "{}") else value
    parts = [part.strip() for part in inside.split(",")]
    spans = [_SPAN.fullmatch(part) for part in parts]
    if any(spans):
        raise XrgsError(f"{key}={value}: {_range_meant(key, parts, is_whole=is_whole)}")
    numbers = inside
    if all(_SEPARATED.fullmatch(part) or re.fullmatch(_NUMBER, part) for part in parts):
        numbers = ",".join(number for part in parts for number in re.split(r"[\s;|]+", part))
    if numbers != inside or (inside != value and "," in inside):
        raise XrgsError(
            f"{key}={value}: several values have commas between them, and no brackets; write"
            f" {key}={numbers}"
        )


def _range_meant(key: str, parts: Sequence[str], *, is_whole: bool) -> str:
    """Return how to write values among which are ranges in people's notation, as `0-3`."""
    written_out = [_written_out(part) if is_whole else [] for part in parts]
    values = [value for some in written_out for value in some]
    if not all(written_out) or not 1 < len(values) <= _FEW:
        begin = parts[0] if not (span := _SPAN.fullmatch(parts[0])) else span[1]
        example = shlex.quote(f"{key}=range({begin},END,STEP)")
        return f"a range is written as {example}, and END is not in it"
    meant = f"{key}={','.join(values)}"
    if len(parts) > 1:
        return f"write {meant}"
    as_range = shlex.quote(f"{key}=range({values[0]},{int(values[-1]) + 1})")
    return f"a range is written as {meant} or {as_range}"


def _written_out(part: str) -> list[str]:
    """Return the whole numbers of a range such as `0-3`, or a number; empty for anything else."""
    match = _SPAN.fullmatch(part)
    ends = match.groups() if match else (part, part)
    if not all(re.fullmatch(r"-?\d+", end) for end in ends):
        return []
    first, last = map(int, ends)
    return [str(value) for value in range(first, min(last, first + _FEW) + 1)]


def _whole(text: str) -> str:
    """Write a whole number as digits, `3e3` as `3000`; any other text stays."""
    if not _WHOLE.fullmatch(text.strip()):
        return text
    value = Decimal(text)  # a float would round a seed above 2^53
    return str(int(value)) if value == value.to_integral_value() else text


def _exists(path: str) -> bool:
    return user_path(path.removesuffix(ALL_BELOW)).exists()


def _literal(text: str) -> str:
    """Escape `${` in a text, unless each interpolation in it names a key or a resolver."""
    named = _INTERPOLATED.findall(text)
    valid = (name.startswith(("oc.", "hydra")) or name in config.known_keys() for name in named)
    return text if named and all(valid) else escape_interpolations(text)


def _parsed(word: str) -> Override | None:
    """Parse a word by Hydra's grammar; None if the grammar refuses it."""
    with suppress(HydraException):
        (override,) = OverridesParser.create().parse_overrides([word])
        return override
    return None


def _quoted_path(key: str, value: str) -> str:
    if _exists(value):
        return _quoted(key, escape_interpolations(value))
    value = _literal(value)
    override = _parsed(f"{key}={value}")
    # No file has that name: keep `null` and escapes of Hydra's grammar.
    if override and (override.value() is None or "\\" in value):
        return value
    return _quoted(key, value)


def _quoted(key: str, value: str) -> str:
    """Quote a text, unless Hydra reads it unchanged without quotes."""
    override = _parsed(f"{key}={value}")
    if override and not override.is_sweep_override() and override.value() == value:
        return value
    return QuotedString(value, Quote.single).with_quotes()


def _quoted_choice(key: str, value: str) -> str:
    """Quote the name of a file of a group, or each name of a list."""
    if value[:1] == "[" and value[-1:] == "]":
        names = [part.strip() for part in _parts(value[1:-1])]
        return f"[{','.join(n if _QUOTED.fullmatch(n) else _quoted(key, n) for n in names)}]"
    return as_name(value) if _parsed(f"{key}={value}") else _quoted(key, value)


def _quoted_lists(value: str) -> str:
    """Quote each name of a list, or of several lists that are an axis."""
    if value.startswith("${") and value == _literal(value):
        return value
    lists = [part.strip() for part in _parts(value)]
    if not all(part.startswith("[") and part.endswith("]") for part in lists):
        lists = [value if value[0] == "[" and value[-1] == "]" else f"[{value}]"]
    names = ([part.strip() for part in _parts(inside[1:-1])] for inside in lists)
    return ",".join(f"[{','.join(map(_quoted_name, filter(None, some)))}]" for some in names)


def _quoted_name(name: str) -> str:
    if _QUOTED.fullmatch(name):
        return name
    return QuotedString(escape_interpolations(name), Quote.single).with_quotes()


def _parts(text: str) -> list[str]:
    """Split a text at commas, except in quotes and, if the brackets balance, in brackets."""
    shape = _QUOTED_PART.sub(lambda quoted: "'" * len(quoted[0]), text)
    depths = list(accumulate(_DEPTH.get(char, 0) for char in shape))
    if depths and (min(depths) < 0 or depths[-1]):
        depths = [0] * len(text)
    cuts = [i for i, char in enumerate(shape) if char == "," and depths[i] == 0]
    return [text[begin + 1 : end] for begin, end in pairwise([-1, *cuts, len(text)])]


def check_words(words: Sequence[str]) -> None:
    """Refuse words that are neither overrides nor options of Hydra.

    Raises:
        XrgsError: A word is a folder, an option of another command, or part of a list with spaces;
            the message has the correction.
    """
    before = ""
    for number, word in enumerate(words):
        key, is_assignment, _ = word.partition("=")
        name = key.lstrip("-").replace("-", "_")
        if before in _HYDRA_VALUES:  # this word is the option's value
            before = ""
            continue
        is_option = word.startswith("-") and key not in _HYDRA_OPTIONS | _HYDRA_VALUES
        if is_option and name in config.known_keys():
            following = words[number + 1 : number + 2]
            value = "true" if name in _FLAGS else (following or ["VALUE"])[0]
            meant = word.lstrip("-") if is_assignment else f"{name}={value}"
            raise XrgsError(f"{word}: there is no such option; write {shlex.quote(meant)}")
        if is_option:
            raise XrgsError(f"{word}: there is no such option; see xrgs-sweep --help")
        if (not is_assignment and word[:1] not in {"-", "~"}) or not key.lstrip("+~"):
            raise XrgsError(_meant(word, before))
        before = word


def replaced_words(words: Sequence[str]) -> list[str]:
    """Return a line on each key that is given several values by several words.

    Hydra takes the last word of a key, as for a script that has defaults before `"$@"`. A shell
    makes such words of `seed={0..3}`, and then an axis was meant.
    """
    given: dict[str, list[str]] = {}
    for word in words:
        key, is_assignment, value = word.partition("=")
        if is_assignment and not key.startswith(("-", "~")):
            given.setdefault(key.lstrip("+"), []).append(value)
    different = {key: [*dict.fromkeys(values)] for key, values in given.items()}
    return [
        f"{key} is given {len(given[key])} times, and {key}={given[key][-1]} replaces the others;"
        f" for all of them write {shlex.quote(f'{key}=' + ','.join(values))}"
        for key, values in different.items()
        if len(values) > 1
    ]


def _meant(word: str, before: str) -> str:
    """Return the message about a word that is neither KEY=VALUE nor an option."""
    if "=" in before and (before.endswith((",", "[")) or word.startswith((",", "]"))):
        return f"{before} {word}: write it without the space: {shlex.quote(before + word)}"
    path = user_path(word.removesuffix(ALL_BELOW))
    if path.exists():
        return f"{word}: to train on these photographs, type: xrgs-train {shlex.quote(word)}"
    if word in files("ablation"):
        return f"{word}: an ablation is given as +ablation={word}"
    if scene := next((s for s in files("scene") if s.rpartition("/")[2] == word), ""):
        return f"{word}: a scene is given as scene={scene}"
    return f"{word}: write KEY=VALUE, as scene=llff/fern; photographs are trained by xrgs-train"


def check_no_axis(words: Sequence[str]) -> None:
    """Refuse overrides with several values, where one config is composed.

    Raises:
        XrgsError: An override is an axis; the message names it.
    """
    for word in words:
        if (override := _parsed(word)) and override.is_sweep_override():
            raise XrgsError(f"{word}: give one value; xrgs-sweep takes several")


def files(group: str) -> list[str]:
    """Return the sorted names of a config group's files; empty if there is no such group."""
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    names = (file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml"))
    return sorted(name.as_posix() for name in names)
