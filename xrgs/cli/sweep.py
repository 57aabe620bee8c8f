"""`xrgs-sweep`: trains a sweep, or one cell again (`rerun=`), or explains a key (`help=`)."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import hydra
from omegaconf import MISSING, DictConfig, OmegaConf

from xrgs import config
from xrgs.cli.options import answer_version, errors_as_messages
from xrgs.cli.overrides import (
    check_words,
    explained,
    files,
    replaced_words,
    with_options_first,
    with_quotes,
)
from xrgs.composing import escape_interpolations
from xrgs.errors import XrgsError, did_you_mean
from xrgs.runtime.machine import end_quickly
from xrgs.runtime.signals import exit_on_signal
from xrgs.runtime.streams import guard_streams, say
from xrgs.safeio.paths import user_path
from xrgs.safeio.records import read_file

#: With this environment variable Hydra leaves errors to its caller.
_FULL_ERROR = "HYDRA_FULL_ERROR"

_HELP = """\
xrgs-sweep [+ablation=NAME[,NAME]...] [scene=NAME] [preset=NAME] [KEY=VALUE[,VALUE]...]...

Trains the baseline and the ablations on mixed-resolution scenes; prints what changed, in percent.
Commas make axes, +ablation=[a,b] stacks. Finished cells are found in the store and not run again.

  +ablation=  {ablation}
  scene=      {scene}
  preset=     {preset}
  +sweeps=    {sweeps}
  seed=0,1    store=FOLDER    data_root=FOLDER    threads=N    dry_run=true
  limits.minutes=N  limits.memory_gb=N    end cells that exceed a limit, and count them as failed
  retry=failed      fail_fast=true        train failed cells again; stop after the first failure
  baseline=false                          train only the ablations

xrgs-sweep rerun=CELL [out=FOLDER] [store=FOLDER] [threads=N] [scene.path=FOLDER]
           [plugins=NAME[,NAME]...]
  trains a finished cell again in another folder, and prints "the same, bit for bit" or what differs

help=KEY explains a key, e.g. help=train.steps or help=variant; --cfg job prints all keys with their
values; --config-dir FOLDER adds YAML files of your own; --hydra-help explains Hydra's own options.
"""

_NOTHING = """\
xrgs-sweep: say what to train:
  xrgs-train FOLDER                    a scene of your photographs
  xrgs-sweep +ablation=consistency     the baseline and one change, on the embedded scene
  xrgs-sweep --help                    all ablations, scenes and studies"""


@dataclass
class PhotographsConf:
    """The present folder of a scene's photographs."""

    path: str | None = None
    """The folder; None for the one in the cell's config."""


@dataclass
class RerunConf:
    """Arguments of `xrgs-sweep rerun=...`; no others are allowed, since they change the cell."""

    rerun: str = MISSING
    """The cell: its folder, or a word for `Store.find_cell`."""
    out: str | None = None
    """Folder to write to; None for `<rerun>.rerun-1` or the next free number."""
    store: str | None = None
    """Store with the cell's variant; None for the store around the cell's folder."""
    threads: int | None = None
    """Number of threads; None for the number in the cell's training."""
    scene: PhotographsConf = field(default_factory=PhotographsConf)
    plugins: str = ""
    """Names of components of other packages that the cell may import, separated by commas."""


def main() -> None:
    """Run `xrgs-sweep [+ablation=NAME] [KEY=VALUE[,VALUE]...]...`."""
    guard_streams()
    end_quickly()
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):  # Hydra's own help takes seconds to list its groups
        groups = ("ablation", "scene", "preset", "sweeps")
        say(_HELP.format(**{group: ", ".join(files(group)) for group in groups}).rstrip())
        return
    answer_version("xrgs-sweep")
    if len(arguments) == 1 and arguments[0].startswith("help="):
        with errors_as_messages("xrgs-sweep"):
            say(explain(arguments[0].removeprefix("help=")))
        return
    if any(argument.startswith("rerun=") for argument in arguments):
        with exit_on_signal(
            "The cell is unchanged; the folder that was begun beside it has no result."
        ):
            _rerun(arguments)
        return
    if not arguments:
        say(_NOTHING, sys.stderr)
        sys.exit(2)
    with errors_as_messages("xrgs-sweep"):
        check_words(arguments)
    for line in replaced_words(arguments):
        say(line, sys.stderr)
    # Hydra requires a plus before these groups, which is easily forgotten.
    words = ["+" + w if w.partition("=")[0] in config.PLUS_GROUPS else w for w in arguments]
    run("xrgs-sweep", words, "Finished cells are kept: run the same command again to continue.")


def run(command: str, words: Sequence[str], hint: str) -> None:
    """Run a sweep with the arguments of `xrgs-sweep`.

    `command` begins messages, and `hint` says, if a signal ends the sweep, what is kept and how to
    continue.

    Raises:
        SystemExit: With code 1 if a cell failed; with a message if the user can correct the
            problem.
    """
    with exit_on_signal(hint), _hydra_errors(command):
        from xrgs.sweep.job import run_hydra_job  # slow to load: not for --help and help=

        sys.argv[1:] = with_options_first(with_quotes(words))
        configured = hydra.main(
            version_base="1.3", config_path=str(config.CONF_DIR), config_name="config"
        )
        configured(run_hydra_job)()


@contextmanager
def _hydra_errors(command: str) -> Iterator[None]:
    """Print errors that the user can correct in one line, and all others with their traceback.

    Without `HYDRA_FULL_ERROR`, Hydra would handle errors itself and advise to set it. Users who
    have set it see the traceback of every error.
    """
    if _FULL_ERROR in os.environ:
        yield
        return
    os.environ[_FULL_ERROR] = "1"
    try:
        with errors_as_messages(command), explained():
            yield
    finally:
        del os.environ[_FULL_ERROR]


def _rerun(arguments: list[str]) -> None:
    from xrgs.store.store import DEFAULT_STORE, Store
    from xrgs.sweep.rerun import rerun

    hint = " (rerun= takes out=, store=, threads=, scene.path= and plugins=)"
    with errors_as_messages("xrgs-sweep"), explained(hint):
        conf = OmegaConf.merge(OmegaConf.structured(RerunConf), texts(arguments))
        out, store = (user_path(path) if path else None for path in (conf.out, conf.store))
        photographs, plugins = conf.scene.path, conf.plugins.split(",")
        cell, home = user_path(conf.rerun), Store(store or DEFAULT_STORE)
        if not cell.exists() and home.exists:
            cell = home.find_cell(conf.rerun).path
        result = rerun(cell, out, store, conf.threads, photographs, plugins)
    say(str(result))
    if result.differences:
        sys.exit(1)


def texts(words: Sequence[str]) -> DictConfig:
    """Convert `KEY=VALUE` words to a config of texts; a merge into a schema converts the values."""
    conf = OmegaConf.create({})
    for word in words:
        key, _, value = word.partition("=")
        OmegaConf.update(conf, key, escape_interpolations(value))
    return conf


_COMMENT = re.compile(r" *# (.*)")
_KEY = re.compile(r"( *)(\w+):(.*?)(?:  # (.*))?")
_WHERE = (
    "Values are those of the baseline. A preset, a scene, a variant or an ablation may set\n"
    "others; xrgs-sweep --cfg job prints the values in effect."
)


class Entry(NamedTuple):
    """A key of `conf/config.yaml`."""

    value: str
    """The value in the baseline, as written; empty for a group of keys."""
    comment: tuple[str, ...]
    """The lines of the comments above and behind the key."""


def explain(key: str) -> str:
    """Return a key's value in the baseline and its comment; for a group, also those of its keys.

    Raises:
        XrgsError: There is no such key; the message offers similar ones.
    """
    keys = entries()
    lines = [
        "\n  ".join([f"{name}={entry.value}" if entry.value else name, *entry.comment])
        for name, entry in keys.items()
        if f"{name}.".startswith(f"{key}.")
    ]
    if not lines:
        raise XrgsError(f"help={key}: there is no such key{did_you_mean(key, keys)}")
    return "\n\n".join([*lines, _WHERE])


def entries() -> dict[str, Entry]:
    """Read the entries of `conf/config.yaml`, keys and groups of keys, in its order.

    Only the YAML of this file is understood: a key with its value on one line, and two more spaces
    of indent for the keys of a group.
    """
    result: dict[str, Entry] = {}
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
            result[key] = Entry(value.strip(), (*above, *([behind] if behind else [])))
        above = []
    return result
