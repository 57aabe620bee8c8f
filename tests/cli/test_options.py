"""Tests of what all commands but xrgs-sweep share: help, version, completion, wrong usage."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import xrgs
from tests.runtime.programs import run_python
from xrgs.cli.options import errors_as_messages
from xrgs.cli.render import render
from xrgs.errors import XrgsError
from xrgs.viewer.paths import PATHS

RunCommand = Callable[..., tuple[int, str, str]]
COMMANDS = ("bench", "data", "render", "report", "status", "store", "train", "view")


@pytest.mark.slow
def test_help_and_a_plan_need_no_module_that_takes_long(
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    photographs: Callable[..., Path],
    without_heavy: str,
) -> None:
    """All commands in one process, in which no such module can be imported."""
    script = """
import sys
from importlib import import_module
words = sys.argv[1:6]
for command in sys.argv[6:]:
    print(f"of {command}:", flush=True)
    sys.argv = [f"xrgs-{command}", "--help"]
    try:
        import_module(f"xrgs.cli.{command}").main()
    except SystemExit as end:
        assert not end.code
sys.argv[1:] = words
import_module("xrgs.cli.sweep").main()
"""
    commands = ("sweep", *COMMANDS)
    scene = photographs(tmp_path_factory.mktemp("scene"), 5)
    words = ("scene=folder", f"scene.path={scene}", "+ablation=consistency", "seed=0,1")
    done = subprocess.run(
        [sys.executable, "-P", "-c", script, *words, "dry_run=true", *commands],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": without_heavy},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for command in commands:
        _, _, text = done.stdout.partition(f"of {command}:\n")
        assert f"xrgs-{command} " in text.splitlines()[0]
    assert "plan: 4 cells" in done.stderr
    assert done.stderr.count("variant not built") == 4
    assert not list(tmp_path.iterdir())  # nothing is written


def test_help_has_what_is_said_of_an_option_without_the_breaks_of_its_lines(
    call_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "800")
    code, out, _ = call_command("render", "--help")
    assert code == 0
    (line,) = (line for line in out.splitlines() if "`orbit` circles" in line)
    assert "all frames have the focal length of the first test view." in line


def test_every_command_says_the_version_of_xrgs(call_command: RunCommand) -> None:
    for command in ("sweep", *COMMANDS):
        found = call_command(command, "--version")
        assert found == (0, f"xrgs-{command} {xrgs.__version__}\n", "")


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("report store=s scenes=a,b", "report --store s --scenes a b"),
        ("report store=a,b", "report --store a,b"),  # there is a folder of that name
        ("store rm dry_run=true", "store rm --dry-run"),
        ("store rm scenes=a 0123 yes=false store=gone", "store rm 0123 --scenes a --store gone"),
        ("data export 0123 format=colmap", "data export 0123 --format colmap"),
        ("bench against=PYTHON repeats=0", "bench --against PYTHON --repeats 0"),
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
        ("report --aginst x", "--against LABEL"),
        ("store", "Missing subcommand"),
        ("store remove", "Available subcommands: list, show, rm"),
        ("store pack", "--out FILE.tar.xz"),
        ("store show --cell a", "--cell"),
        ("data download", "{llff}"),
        ("data export a --format obj", "'colmap', 'nerfstudio'"),
        ("render abc --size 504", "--size"),
        ("report --store=", "--store: is empty; give a path"),
        ("train garden --store=", "--store: is empty; give a path"),
        ("bench --load=", "is empty; give a path"),
        # As of a variable that is not set: none would mean all, and an empty id begins every id.
        ("store trim --yes --sweep", "--sweep: takes a value, and none or an empty one is given"),
        ("store rm --yes --scenes=", "--scenes: takes a value, and none or an empty one is given"),
        ("report --against=", "--against: takes a value, and none or an empty one is given"),
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
        ("train --dry-run", "give a folder of photographs, or a video"),
        ("data inspect", "inspect: give a folder of photographs, a variant, a cell, or overrides"),
        ("data export --out a.ply", "export: give a cell, a variant, or a file of Gaussians"),
        ("store show", "show: give a cell"),
        ("store import", "import: give an archive, or the folder of a store"),
        ("render abc", "--store xrgs-store is not a store"),
        ("view abc --limit 0", "--limit 0: must be at least 1"),
        ("view gone.ply", "gone.ply: cannot be read"),
        ("train . store=", "store=: is empty; give a path"),
        ("data inspect . store=", "store=: is empty; give a path"),
        # Overrides before and behind options
        ("train gone seed=1 --size 250 +ablation=plus", "gone: there is no such folder"),
        ("train seed=1 --dry-run gone", "gone: there is no such folder"),
        ("data inspect gone --store s seed=1 --out a=b.txt", "--out a=b.txt: the sheet is a PNG"),
    ],
)
def test_an_error_is_a_message_and_ends_with_1(
    call_command: RunCommand, words: str, message: str
) -> None:
    command, *arguments = words.split()
    code, out, err = call_command(command, *arguments)
    assert (code, out) == (1, "")
    assert err.startswith(f"xrgs-{command}: {message}")


def test_an_error_is_one_line_and_no_other_exception_is_hidden() -> None:
    with pytest.raises(SystemExit) as end, errors_as_messages("xrgs-x"):
        raise XrgsError("two\nlines")
    assert end.value.code == "xrgs-x: two lines"
    with pytest.raises(ZeroDivisionError), errors_as_messages("xrgs-x"):
        raise ZeroDivisionError


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "code", "message"),
    [
        ("import xrgs.cli; {stop}", -signal.SIGINT, ""),  # as during the imports of a command
        (
            "from xrgs.cli import options\ndef f(): {stop}\noptions.run('xrgs-x', f, hint='Go.')",
            128 + signal.SIGINT,
            "stopped by SIGINT. Go.\n",
        ),
    ],
)
def test_ctrl_c_ends_a_command_without_a_traceback(script: str, code: int, message: str) -> None:
    stop = "signal.raise_signal(signal.SIGINT)"
    begin = "import signal, sys\nsys.argv = ['xrgs-x']\n"
    done = run_python(begin + script.format(stop=stop))
    assert (done.returncode, done.stderr) == (code, message)


def test_the_paths_of_a_film_can_all_be_chosen() -> None:
    names, none = get_args(get_type_hints(render)["path"])
    assert (get_args(names), none) == (tuple(PATHS), type(None))


def test_bash_completes_a_command(call_command: RunCommand, tmp_path: Path) -> None:
    if (bash := shutil.which("bash")) is None:
        pytest.skip("there is no bash")
    assert call_command("store", "--tyro-write-completion", "bash", "completion")[0] == 0
    for line, wanted in (("xrgs-store t", "trim"), ("xrgs-store list --so", "--sort")):
        script = (
            "source completion; function=$(complete -p xrgs-store | cut -d' ' -f3);"
            f"COMP_WORDS=({line}); COMP_CWORD={len(line.split()) - 1}; $function; echo $COMPREPLY"
        )
        done = subprocess.run([bash, "-c", script], cwd=tmp_path, capture_output=True, check=True)
        assert done.stdout.decode().split() == [wanted]


@pytest.mark.parametrize("words", ["status --store=~/s", "store list store=~/s"])
def test_the_home_folder_of_every_option_is_expanded(
    call_command: RunCommand, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.setenv("HOME", "/nowhere")
    _, out, err = call_command(*words.split())
    assert "/nowhere/s" in out + err
    assert "~" not in out + err


@pytest.mark.parametrize("command", ["view", "store rm --yes", "data export"])
def test_an_empty_cell_is_no_beginning_of_an_id(call_command: RunCommand, command: str) -> None:
    code, out, err = call_command(*command.split(), "")
    assert (code, out) == (2, "")
    assert "takes a value, and none or an empty one is given" in " ".join(err.split())
