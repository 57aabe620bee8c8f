"""Tests of what all commands but xrgs-sweep share: help, version, completion, wrong usage."""

from __future__ import annotations

import errno
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import xrgs
from xrgs.cli.options import errors_as_messages
from xrgs.cli.render import render
from xrgs.errors import XrgsError
from xrgs.viewer.paths import PATHS

RunCommand = Callable[..., tuple[int, str, str]]
COMMANDS = ("bench", "data", "render", "report", "status", "store", "train", "view")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["sweep", *COMMANDS])
def test_help_answers_at_once(
    run_command: RunCommand, tmp_path: Path, without_heavy: str, command: str
) -> None:
    code, out, err = run_command(command, tmp_path, "--help", PYTHONPATH=without_heavy)
    assert code == 0, err
    assert f"xrgs-{command} " in out.splitlines()[0]


def test_help_has_what_is_said_of_an_option_without_the_breaks_of_its_lines(
    call_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "800")
    code, out, _ = call_command("render", "--help")
    assert code == 0
    (line,) = (line for line in out.splitlines() if "`orbit` circles" in line)
    assert "have the focal length of the first test view." in line


@pytest.mark.parametrize("command", ["sweep", *COMMANDS])
def test_every_command_says_the_version_of_xrgs(call_command: RunCommand, command: str) -> None:
    found = call_command(command, "--version")
    assert found == (0, f"xrgs-{command} {xrgs.__version__}\n", "")


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("report out=FOLDER", "report --out FOLDER"),
        ("report store=s scenes=a,b", "report --store s --scenes a b"),
        ("report store=a,b", "report --store a,b"),  # there is a folder of that name
        ("store rm dry_run=true", "store rm --dry-run"),
        ("store rm scenes=a 0123 yes=false store=gone", "store rm 0123 --scenes a --store gone"),
        ("data export 0123 format=colmap", "data export 0123 --format colmap"),
        ("data inspect scene=video out=a.png", "data inspect scene=video --out a.png"),
        ("bench against=PYTHON repeats=0", "bench --against PYTHON --repeats 0"),
        ("status stroe=s", "status --stroe s"),
    ],
)
def test_options_are_taken_in_hydra_s_syntax_too(
    call_command: RunCommand, tmp_path: Path, words: str, options: str
) -> None:
    (tmp_path / "a,b").mkdir()
    assert call_command(*words.split()) == call_command(*options.split())


def test_a_current_folder_that_was_removed_is_named(
    call_command: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone() -> Path:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    monkeypatch.setattr(Path, "cwd", gone)
    code, _, err = call_command("status", "--store", str(tmp_path))
    assert code == 1
    assert err.startswith("xrgs-status: the current folder can't be found")


def test_a_value_behind_an_option_may_have_an_equals_sign(
    call_command: RunCommand, tmp_path: Path
) -> None:
    code, _, err = call_command("report", "--scenes", "a=b", "c=d", f"store={tmp_path / 'gone'}")
    assert code == 1
    assert "gone is not a store" in err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("status --stroe s", "--stroe"),
        ("status s", "Unrecognized options: s"),
        ("report --aginst x", "--against LABEL"),
        ("store", "Missing subcommand"),
        ("store remove", "Available subcommands: list, show, rm"),
        ("store list --sort weight", "'name', 'age', 'size'"),
        ("store gc abc", "Unrecognized options: abc"),
        ("store show", "CELL"),
        ("store pack", "--out"),
        ("data download", "{llff}"),
        ("data download mnist", "'llff'"),
        ("data export a --format obj", "'colmap', 'nerfstudio'"),
        ("render abc --views many", "--views"),
        ("render abc --size 504", "--size"),
        ("bench --repeats many", "--repeats"),
    ],
)
def test_wrong_usage_is_named_and_ends_with_2(
    call_command: RunCommand, monkeypatch: pytest.MonkeyPatch, words: str, named: str
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    command, *arguments = words.split()
    code, out, err = call_command(command, *arguments)
    assert (code, out) == (2, "")
    assert named in err
    assert f"xrgs-{command}" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("render", "give one cell or 2"),
        ("render abc", "--store xrgs-store is not a store"),
        ("report --store gone", "--store gone is not a store"),
        ("report list --store gone", "--store gone is not a store"),
        ("status --store gone", "--store gone is not a store"),
        ("view", "give one cell or 2"),
        ("view abc --limit 0", "--limit 0: must be at least 1"),
        ("view gone.ply", "gone.ply: cannot be read"),
    ],
)
def test_an_error_is_a_message_and_ends_with_1(
    call_command: RunCommand, words: str, message: str
) -> None:
    command, *arguments = words.split()
    code, out, err = call_command(command, *arguments)
    assert (code, out) == (1, "")
    assert err.startswith(f"xrgs-{command}: {message}")


def test_an_error_is_one_line() -> None:
    with pytest.raises(SystemExit) as end, errors_as_messages("xrgs-x"):
        raise XrgsError("two\nlines")
    assert end.value.code == "xrgs-x: two lines"


def test_other_errors_are_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError), errors_as_messages("xrgs-x"):
        raise ZeroDivisionError


def test_the_paths_of_a_film_can_all_be_chosen() -> None:
    names, none = get_args(get_type_hints(render)["path"])
    assert (get_args(names), none) == (tuple(PATHS), type(None))


@pytest.mark.parametrize(
    ("line", "wanted"),
    [("xrgs-store t", "trim"), ("xrgs-store list --so", "--sort"), ("xrgs-store rm --y", "--yes")],
)
def test_bash_completes_a_command(
    call_command: RunCommand, tmp_path: Path, line: str, wanted: str
) -> None:
    if (bash := shutil.which("bash")) is None:
        pytest.skip("there is no bash")
    assert call_command("store", "--tyro-write-completion", "bash", "completion")[0] == 0
    script = (
        "source completion; function=$(complete -p xrgs-store | cut -d' ' -f3);"
        f"COMP_WORDS=({line}); COMP_CWORD={len(line.split()) - 1}; $function; echo $COMPREPLY"
    )
    done = subprocess.run([bash, "-c", script], cwd=tmp_path, capture_output=True, check=True)
    assert done.stdout.decode().split() == [wanted]


@pytest.mark.parametrize("word", ["--store=~/s", "store=~/s"])
@pytest.mark.parametrize("command", ["status", "report", "store list"])
def test_the_home_folder_of_every_option_is_expanded(
    call_command: RunCommand, monkeypatch: pytest.MonkeyPatch, word: str, command: str
) -> None:
    monkeypatch.setenv("HOME", "/nowhere")
    _, out, err = call_command(*command.split(), word)
    assert "/nowhere/s" in out + err
    assert "~" not in out + err
