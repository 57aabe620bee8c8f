"""Tests of work in a child process: its answer, its errors, and its death."""

from __future__ import annotations

import errno
import faulthandler
import json
import os
import signal
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.runtime import machine
from xrgs.sweep import job
from xrgs.sweep.job import INTERRUPTED, LOCKED, UNWRITABLE, ProcessEnd, WorkError, run_in_child


@pytest.fixture
def child(monkeypatch: pytest.MonkeyPatch) -> Callable[[ProcessEnd, object], None]:
    """(end, answer) -> stand in for the child process: it writes the answer and ends like this."""

    def stands_in(end: ProcessEnd, answer: object = None) -> None:
        def run(command: Sequence[str], *_: object) -> ProcessEnd:
            assert json.loads(Path(command[-2]).read_text()) == {"number": 1}
            if answer is not None:
                Path(command[-1]).write_text(json.dumps(answer))
            return end

        monkeypatch.setattr(job, "run_supervised", run)

    return stands_in


def test_the_answer_of_the_child_is_returned(child: Callable[..., None]) -> None:
    child(ProcessEnd(0), {"result": {"variant": "v"}})
    assert run_in_child("variant", {"number": 1}) == {"variant": "v"}


@pytest.mark.parametrize(
    ("end", "answer", "outcome", "message"),
    [
        (ProcessEnd(0), {"error": "no photographs"}, "failed", "no photographs"),
        (ProcessEnd(os.EX_TEMPFAIL), {"error": "x", "outcome": LOCKED}, LOCKED, "x"),
        (ProcessEnd(-signal.SIGTERM, "it took too long"), None, "failed", "it took too long"),
        (ProcessEnd(os.EX_IOERR), None, UNWRITABLE, "set TMPDIR"),
        (ProcessEnd(3), None, "failed", "ended with exit code 3 before it answered"),
        (ProcessEnd(-signal.SIGTERM), None, INTERRUPTED, "ended by SIGTERM$"),
        (ProcessEnd(-signal.SIGSEGV), None, "failed", "ended by SIGSEGV$"),
        (ProcessEnd(-signal.SIGKILL), None, "failed", r"ended by SIGKILL \(out of memory\?\)"),
    ],
)
def test_what_went_wrong_in_the_child_is_raised(
    child: Callable[..., None],
    end: ProcessEnd,
    answer: object,
    outcome: str,
    message: str,
) -> None:
    child(end, answer)
    with pytest.raises(WorkError, match=message) as caught:
        run_in_child("cell", {"number": 1})
    assert caught.value.outcome == outcome


def test_a_machine_without_a_folder_for_temporary_files_is_told_what_to_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/gone"])
    with pytest.raises(WorkError, match="set TMPDIR") as caught:
        run_in_child("cell", {"number": 1})
    assert caught.value.outcome == UNWRITABLE


@pytest.fixture
def in_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Callable[..., dict[str, Any]]], dict[str, Any]]:
    """(work) -> the answer that the child's `main` writes when it does this work."""
    monkeypatch.setattr(job, "follow_parent", lambda: None)
    monkeypatch.setattr(machine, "offer_to_oom_killer", lambda: None)
    monkeypatch.setattr(job, "guard_streams", lambda: None)
    monkeypatch.setattr(faulthandler, "enable", lambda: None)

    def answered(work: Callable[..., dict[str, Any]]) -> dict[str, Any]:
        monkeypatch.setitem(job._WORK, "cell", work)
        (tmp_path / "request").write_text('{"number": 1}')
        job.main("cell", str(tmp_path / "request"), str(tmp_path / "answer"))
        answer = json.loads((tmp_path / "answer").read_text())
        return {key: value for key, value in answer.items() if value not in ({}, None, "failed")}

    return answered


def raising(error: Exception) -> Callable[..., dict[str, Any]]:
    def work(_: object) -> dict[str, Any]:
        raise error

    return work


def test_the_child_answers_with_the_result_or_the_error(
    in_this_process: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert in_this_process(lambda request: {"twice": 2 * request["number"]}) == {
        "result": {"twice": 2}
    }
    assert in_this_process(raising(XrgsError("no photographs"))) == {"error": "no photographs"}
    assert capsys.readouterr().err == ""
    for number in (errno.ENOSPC, errno.EROFS):
        answer = in_this_process(raising(OSError(number, "no room")))
        assert answer == {"error": f"OSError: [Errno {number}] no room", "outcome": UNWRITABLE}
    assert capsys.readouterr().err == ""  # the sweep says it in a line
    stale = in_this_process(raising(OSError(errno.ESTALE, "stale")))
    assert stale == {"error": "OSError: [Errno 116] stale"}
    other = in_this_process(raising(KeyError("k")))
    assert other == {"error": "KeyError: 'k'"}
    assert "Traceback" in capsys.readouterr().err


def test_a_child_that_can_not_write_its_answer_says_so_by_its_exit_code(
    in_this_process: Callable[..., dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no room")

    monkeypatch.setattr(job, "write_json", full)
    with pytest.raises(SystemExit) as end:
        in_this_process(lambda _: {})
    assert end.value.code == os.EX_IOERR
    assert capsys.readouterr().err == ""


def test_a_child_whose_store_is_gone_leaves_it_to_its_parent_to_say_so(
    in_this_process: Callable[..., dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(job, "read_struct", lambda *_: {"store": str(tmp_path / "gone")})
    answer = in_this_process(raising(FileNotFoundError(errno.ENOENT, "gone")))
    assert answer == {"error": "FileNotFoundError: [Errno 2] gone"}
    assert capsys.readouterr().err == ""
