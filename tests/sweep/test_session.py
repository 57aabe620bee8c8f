"""Tests of a session's folder: who owns it, and when it is over."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable

from xrgs.sweep.job import SweepSession


def signed_by(session: SweepSession, **changes: object) -> SweepSession:
    """Return the session as that of another process."""
    file = session.folder / "sweep"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return SweepSession(session.folder)


def test_a_session_is_over_when_it_is_stopped_or_its_process_has_ended(
    session: SweepSession,
) -> None:
    assert not session.stopped
    assert signed_by(session, started=1).stopped == "the process of the sweep has ended"
    assert not signed_by(session, host="elsewhere").stopped  # it may run there
    assert not signed_by(session, boot="another").stopped
    for reason in ("the first", "the second"):
        session.stop(reason)
        assert str(session.stopped) == "the first"


def test_a_session_whose_folder_is_gone_is_over_and_does_not_reappear(
    session: SweepSession,
) -> None:
    assert session.exists
    path = session.folder
    path.rename(path.with_name("moved"))
    assert not session.exists
    assert session.stopped == f"{path} is no longer there"
    session.stop("a reason")
    assert not path.exists()


def test_a_reason_that_can_not_be_read_now_stops_nothing(
    session: SweepSession, unreadable: Callable[..., None]
) -> None:
    session.stop("enough\x1b[31m\nof it")
    unreadable("stopped", errno.EIO)
    assert str(session.stopped) == ""
    unreadable("", 0)
    assert str(session.stopped) == "enough [31m of it"


def test_the_folder_of_a_session_that_is_over_is_removed_without_logs(
    session: SweepSession,
) -> None:
    log = session.folder / ".submitit" / "log"
    log.parent.mkdir()
    log.touch()
    session.end()
    assert log.exists()
    assert session.exists
    log.unlink()
    (session.folder / "stopped").touch()  # a disk too full for the reason
    assert session.stopped == f"{session.folder / 'stopped'} exists"
    session.end()
    assert not session.folder.exists()
    session.end()
