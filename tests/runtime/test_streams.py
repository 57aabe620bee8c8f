"""Printing to a closed terminal, a pipe without a reader, a full disk, and no stream at all."""

from __future__ import annotations

import io
import os
import pty
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pyte
import pytest

from tests.runtime.programs import run_python
from xrgs.runtime.streams import redraw, say

_SCRIPT = """
import sys
from pathlib import Path
if sys.argv[1] == "guard":
    from xrgs.runtime.streams import guard_streams
    guard_streams()
for stream in (sys.stdout, sys.stderr):
    print("text", file=stream, flush=True)
Path("done").write_text(f"{sys.stdout.isatty()} {sys.stdout.encoding}")
"""


@contextmanager
def _terminal() -> Iterator[int]:
    master, slave = pty.openpty()
    os.close(master)
    yield slave
    os.close(slave)


@contextmanager
def _pipe() -> Iterator[int]:
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@contextmanager
def _full_disk() -> Iterator[int]:
    with Path("/dev/full").open("wb") as full:
        yield full.fileno()


@pytest.mark.parametrize(
    ("gone", "how"),
    [(_terminal, "guard"), (_pipe, "guard"), (_full_disk, "guard"), (_pipe, "default")],
)
def test_the_work_goes_on_without_a_reader(
    tmp_path: Path, gone: Callable[[], AbstractContextManager[int]], how: str
) -> None:
    with gone() as there:
        done = run_python(
            _SCRIPT, how, cwd=tmp_path, stdout=there, stderr=there, capture_output=False
        )
    assert (done.returncode == 0) == (how == "guard")
    assert (tmp_path / "done").exists() == (how == "guard")


@pytest.mark.parametrize("closed", [(1,), (0, 1, 2)])
def test_a_file_never_gets_the_text_for_a_closed_stream(
    tmp_path: Path, closed: tuple[int, ...]
) -> None:
    script = """
import os, sys
from xrgs.runtime.streams import guard_streams, say
guard_streams()
with open("file", "w") as file:
    for stream in (sys.stdout, sys.stderr):
        say("text", stream)
    os.system("echo of a child; echo of a child >&2")  # as a library prints
    file.write(f"{sys.stdin.isatty()} {sys.stdin.read()!r}")
"""

    def close() -> None:
        for descriptor in closed:
            os.close(descriptor)

    done = run_python(script, cwd=tmp_path, check=True, stdin=subprocess.DEVNULL, preexec_fn=close)
    assert (tmp_path / "file").read_text() == "False ''"
    said = "text\nof a child\n"
    assert (done.stdout, done.stderr) == ("" if 1 in closed else said, "" if 2 in closed else said)


def test_a_terminal_that_draws_over_nothing_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for term, said in (("xterm", "\r\x1b[Ka\n"), ("dumb", "a\n")):
        monkeypatch.setenv("TERM", term)
        say("a", terminal := Terminal())
        assert terminal.getvalue() == said


def test_a_character_that_the_stream_lacks_is_a_number() -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    say("é 部 ↑", stream)
    assert stream.buffer.getvalue() == b"\xe9 \\u90e8 \\u2191\n"


def test_a_line_is_one_write_so_that_no_other_thread_writes_into_it() -> None:
    class Writes(io.StringIO):
        def write(self, text: str) -> int:
            writes.append(text)
            return super().write(text)

    writes = list[str]()
    say("two words", Writes())
    assert writes == ["two words\n"]


def test_a_message_of_a_log_is_one_line_and_a_traceback_keeps_its_lines() -> None:
    script = (
        "import logging\n"
        "from xrgs.runtime.streams import log_to_stderr\n"
        "log_to_stderr()\n"
        "log = logging.getLogger('xrgs.x')\n"
        "log.info('not shown')\n"
        "log.warning('%s; left out', 'a\\n2026-01-01 forged\\x1b[2J')\n"
        "try:\n"
        "    raise ValueError('\\x1b]0;t\\x07')\n"
        "except ValueError:\n"
        "    log.exception('failed')\n"
    )
    done = run_python(script, check=True)
    first, second, *traceback = done.stderr.splitlines()
    assert first.endswith(" a 2026-01-01 forged [2J; left out")
    assert second.endswith(" failed")
    assert traceback[0] == "Traceback (most recent call last):"
    assert traceback[-1] == "ValueError:  ]0;t "


def test_a_text_that_is_drawn_again_replaces_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "get_terminal_size", lambda: os.terminal_size((12, 5)))
    screen, terminal = pyte.Screen(12, 5), io.StringIO()
    drawn = redraw("one\nwider than that\n\x1b[31mthree\nfour\nfive", 0, terminal)
    screen_of = pyte.Stream(screen)
    screen_of.feed(terminal.getvalue().replace("\n", "\r\n"))
    shown = [line.rstrip() for line in screen.display]
    assert shown == ["one", "wider than", " [31mthree", "four", ""], "cut, and no colour"
    terminal.truncate(0)
    terminal.seek(0)
    redraw("six\nseven", drawn, terminal)
    screen_of.feed(terminal.getvalue().replace("\n", "\r\n"))
    assert [line.rstrip() for line in screen.display] == ["six", "seven", "", "", ""]
