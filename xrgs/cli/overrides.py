"""Hydra's overrides on a command line: paths with any character, and messages about wrong ones."""

from __future__ import annotations

import re
import shlex
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import YAMLError

from xrgs import composing, config
from xrgs.composing import escape_interpolations
from xrgs.errors import XrgsError, did_you_mean
from xrgs.photos.scenes.scene import ALL_BELOW
from xrgs.safeio.paths import user_path
from xrgs.sweep.axis_values import as_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hydra.core.override_parser.types import Override

#: How Hydra says that a file of the config can't be merged into the others.
_IN_FILE = re.compile(r"In '([^']+)': \w+ raised while composing config:\n")
#: How Hydra says that a key of an override is unknown.
_NOT_OVERRIDDEN = re.compile(r"Could not override '([^']+)'")
#: A text in quotes, and such a text where it is a whole value of a list.
_IN_QUOTES = r"""(['"])(?:\\.|(?!\1).)*\1"""
_QUOTED, _QUOTED_PART = (
    re.compile(_IN_QUOTES),
    re.compile(rf"(?:^|(?<=[\[,]))\s*{_IN_QUOTES}(?=\s*(?:[\],]|$))"),
)
#: By how much a bracket changes the depth of what is behind it.
_DEPTH = dict.fromkeys("([{", 1) | dict.fromkeys(")]}", -1)
_CLOSES = {"(": ")", "[": "]", "{": "}"}
#: A comma at an end of a list, or behind another one.
_LONE_COMMA = re.compile(r"^[\s,]+|(?<=[(\[{,])[\s,]+|[\s,]+(?=[)\]}]|$)")
#: How Hydra says that a function of an override fails.
_CALL = re.compile(
    r"(?P<kind>\w+) while evaluating '(?P<call>(?P<name>\w+)\((?P<inside>.*?)\))': (?P<reason>.*)"
)
#: The key or the resolver of an interpolation.
_INTERPOLATED = re.compile(r"\$\{([^:}]*)")
#: Options of Hydra; those of the second set have a value.
_HYDRA_OPTIONS = frozenset(
    {"-h", "--help", "--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m"}
    | {"--shell-completion", "-sc"}
)
_HYDRA_VALUES = frozenset(
    {"--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn"}
    | {"--config-dir", "-cd", "--experimental-rerun", "--info", "-i"}
)
#: Keys that are switched on by `true`.
_FLAGS = frozenset({"dry_run", "fail_fast"})
#: The most names that a message lists.
_MAX_LISTED = 20
#: A number that is whole, and not written so: 3e3, 100.0.
_WHOLE = re.compile(r"\d+(?:\.\d*)?(?:[eE]\+?\d+)?|\d+\.0*")
#: Keys whose values are lists of names.
_NAMES = frozenset({"variant.test"})
#: Those whose value is a folder, and the one that needs no value.
_FOLDERS = frozenset({"--config-dir", "-cd", "--config-path", "-cp"})
_INFO = frozenset({"--info", "-i"})
#: What asks Hydra for something else than a sweep.
_OTHER_MODES = frozenset(
    (
        *_INFO,
        "--cfg",
        "-c",
        "--run",
        "-r",
        "hydra.mode",
        "--hydra-help",
        "--shell-completion",
        "-sc",
    )
)


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
    except (YAMLError, UnicodeDecodeError) as error:
        raise XrgsError(f"a YAML file of the config can't be read: {error}") from error


def _explained(error: Exception) -> str:
    """Return what an error of Hydra or OmegaConf says, with names like one that does not exist.

    Hydra's own advice is left out: `steps=100` would be told to become `+steps=100`, which adds a
    key that nothing reads.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _missing_file(error.missing_cfg_file, error.options or ())
    if isinstance(error, OverrideParseException):
        return _malformed(str(error.override), str(error))
    if found := _IN_FILE.match(str(error)):
        return _wrong_file(found[1], error.__context__ or error)
    if found := _NOT_OVERRIDDEN.search(str(error)):
        key = found[1].partition("@")[0]
        return f"{key}: there is no such key{did_you_mean(key, config.known_keys())}"
    offered = ""
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        parent = error.parent_node
        known = tuple(map(str, parent)) if isinstance(parent, DictConfig) else ()
        offered = did_you_mean(str(error.key), known)
    elif isinstance(error.__cause__, OmegaConfBaseException):  # it names the key and the value
        return _explained(error.__cause__)
    return composing.error_line(error) + offered


def _malformed(word: str, said: str) -> str:
    """Return what to type in place of a word that Hydra's grammar refuses, and says so."""
    key, _, value = word.partition("=")
    call = _CALL.search(said)
    whole, name, inside = call.group("call", "name", "inside") if call else ("", "", "")
    axis = inside if inside.endswith(")") else whole
    candidates = (
        ("a comma has no value beside it", _LONE_COMMA.sub("", value)),
        ("there is one = too many", value.lstrip("=")),
        ("a bracket is not closed", value + _closing(value)),
        ("axes are not in brackets", value[1:-1] if value[:1] + value[-1:] == "()" else value),
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
    """Return the brackets that close those that are open at the end of a text."""
    still_open: list[str] = []
    for sign in _QUOTED.sub("", text):
        if sign in _CLOSES:
            still_open.append(_CLOSES[sign])
        elif still_open and sign == still_open[-1]:
            still_open.pop()
    return "".join(reversed(still_open))


def _wrong_file(file: str, error: BaseException) -> str:
    """Return what is wrong in a file of the config, which can't be merged into the others."""
    group = file.partition("/")[0]
    key = str(getattr(error, "full_key", ""))
    if key not in config.types_of(config.Conf) and (key == group or key.startswith("_")):
        reason = "its first line must be `# @package _global_`"
    else:
        reason = _explained(error) if isinstance(error, Exception) else str(error)
    return f"{file}.yaml: {reason}"


def _missing_file(file: str, options: Sequence[str]) -> str:
    """Return what is said of `GROUP/NAME` where there is no such file of the config."""
    group = next((g for g in config.GROUPS if file.startswith(f"{g}/")), file.rpartition("/")[0])
    name = file.removeprefix(f"{group}/")
    if not (known := sorted({*files(group), *options})):
        return f"{group}: there is no such key{did_you_mean(group, config.known_keys())}"
    if group == "scene" and user_path(name).is_dir():
        word = shlex.quote(f"scene.path={name}")
        return f"scene={name}: a folder of photographs is given as scene=folder {word}"
    if group == "ablation" and name in composing.ARMS:
        return (
            f"ablation={name}: it is in a package of its own: pip install ./examples/arms, and"
            " xrgs-sweep --config-dir examples/arms/conf finds it"
        )
    all_known = f"; choose from: {', '.join(known)}"
    if len(known) > _MAX_LISTED:
        all_known = f"; xrgs-sweep --help lists all {len(known)}"
    offered = did_you_mean(name, known) or all_known
    return f"{group}={name}: there is no such choice{offered}"


def with_options_first(words: Sequence[str]) -> list[str]:
    """Return a command line as Hydra's parser takes it: its options first, then all overrides.

    `--multirun` is added where Hydra is asked for a sweep: without it, Hydra checks axes before
    anything else, and blames them for every other mistake.

    Args:
        words: Arguments of the command line, in any order.
    """
    options: list[str] = []
    overrides: list[str] = []
    left = list(words)
    while left:
        word = left.pop(0)
        if not word.startswith("-"):
            overrides.append(word)
            continue
        name, _, value = word.partition("=")
        if name in _HYDRA_VALUES - _INFO and not value and left:
            value = left.pop(0)
        if name in _INFO and not value:
            value = left.pop(0) if left and "=" not in left[0] else "all"
        if name in _FOLDERS and value:
            value = str(user_path(value))
        if name not in ("--multirun", "-m"):
            options += [name, value] if value else [name]
    other = [word for word in (*options, *overrides) if word.partition("=")[0] in _OTHER_MODES]
    if not other:
        options.append("--multirun")
    return options + overrides


def with_quotes(words: Sequence[str]) -> list[str]:
    """Return Hydra overrides, with quotes around paths and names that Hydra would read otherwise.

    Paths and names may have any character; a value that is in quotes already stays as it is. Commas
    in `scene.path` and in groups of files separate the values of an axis, unless there is a folder
    of that name. A list of names is `[a,b]`, or `a,b`; `[a,b],[c]` is an axis of two lists. Hydra
    reads all other keys.

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
    signed, _, value = word.partition("=")
    key = signed.lstrip("+")
    if not value:
        return word
    if key in _NAMES:
        quoted = _quoted_lists(value)
    elif value[0] in "'\"" and _parsed(word):
        quoted = value
    elif key in config.GROUPS:
        quoted = ",".join(_quoted_choice(key, part) for part in _parts(value))
    elif key == "scene.name":
        quoted = _quoted(key, escape_interpolations(value))
    elif key in config.PATHS:
        parts = value.split(",") if key == "scene.path" and not _exists(value) else [value]
        quoted = ",".join(_quoted_path(key, part) for part in parts)
    elif _is_whole_number(key):
        quoted = ",".join(map(_whole, value.split(",")))
    else:
        quoted = value
    return f"{signed}={quoted}"


def _is_whole_number(key: str) -> bool:
    """Return whether a key of the schema is a whole number."""
    kind: Any = config.Conf
    for name in key.split("."):
        kind = config.types_of(cast("Any", kind)).get(name) if is_dataclass(kind) else None
    return kind is int


def _whole(text: str) -> str:
    """Return a whole number as digits, `3000` for `3e3`; another text as it is."""
    if not _WHOLE.fullmatch(text.strip()) or not (value := float(text)).is_integer():
        return text
    return str(int(value))


def _exists(path: str) -> bool:
    return user_path(path.removesuffix(ALL_BELOW)).exists()


def _literal(text: str) -> str:
    """Escape `${` in a text, unless each interpolation in it names a key or a resolver."""
    named = _INTERPOLATED.findall(text)
    known = (name.startswith(("oc.", "hydra")) or name in config.known_keys() for name in named)
    return text if named and all(known) else escape_interpolations(text)


def _parsed(word: str) -> Override | None:
    """Return what Hydra reads from a word; None where its grammar refuses the word."""
    with suppress(HydraException):
        (override,) = OverridesParser.create().parse_overrides([word])
        return override
    return None


def _quoted_path(key: str, value: str) -> str:
    if _exists(value):
        return _quoted(key, escape_interpolations(value))
    value = _literal(value)
    override = _parsed(f"{key}={value}")
    # The word null, and the escapes of Hydra's grammar, where there is no file of that name.
    if override and (override.value() is None or "\\" in value):
        return value
    return _quoted(key, value)


def _quoted(key: str, value: str) -> str:
    """Return a text in quotes, or as it is if Hydra reads it as it is written."""
    override = _parsed(f"{key}={value}")
    if override and not override.is_sweep_override() and override.value() == value:
        return value
    return QuotedString(value, Quote.single).with_quotes()


def _quoted_choice(key: str, value: str) -> str:
    """Return the name of a file of a group, or a list of names, as Hydra reads names."""
    if value[:1] == "[" and value[-1:] == "]":
        names = [part.strip() for part in _parts(value[1:-1])]
        return f"[{','.join(n if _QUOTED.fullmatch(n) else _quoted(key, n) for n in names)}]"
    return as_name(value) if _parsed(f"{key}={value}") else _quoted(key, value)


def _quoted_lists(value: str) -> str:
    """Return one list of names, or several that are an axis, with quotes around each name."""
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
    """Split a text at its commas, but for those in quotes and, where they balance, in brackets."""
    shape = _QUOTED_PART.sub(lambda quoted: "'" * len(quoted[0]), text)
    depths = list(accumulate(_DEPTH.get(char, 0) for char in shape))
    if depths and (min(depths) < 0 or depths[-1]):
        depths = [0] * len(text)
    cuts = [i for i, char in enumerate(shape) if char == "," and depths[i] == 0]
    return [text[begin + 1 : end] for begin, end in pairwise([-1, *cuts, len(text)])]


def check_words(words: Sequence[str]) -> None:
    """Refuse words that are no overrides of Hydra and none of its options, and say what was meant.

    Raises:
        XrgsError: A folder, an option of another command, or a list with spaces; the message has
            what to type.
    """
    before = ""
    for number, word in enumerate(words):
        key, is_assignment, _ = word.partition("=")
        name = key.lstrip("-").replace("-", "_")
        if before in _HYDRA_VALUES:  # its value
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
    """Refuse overrides with several values, where one cell is trained.

    Raises:
        XrgsError: An override is an axis; the message names it.
    """
    for word in words:
        if (override := _parsed(word)) and override.is_sweep_override():
            raise XrgsError(f"{word}: give one value; xrgs-sweep takes several")


def files(group: str) -> list[str]:
    """Return the names of a config group's files, sorted; empty where there is no such group.

    Args:
        group: Name of the group's folder, as `scene`.
    """
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    names = (file.relative_to(folder).with_suffix("") for file in folder.rglob("*.yaml"))
    return sorted(name.as_posix() for name in names)
