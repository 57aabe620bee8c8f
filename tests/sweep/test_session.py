"""Tests of a session's folder: who owns it, when it is over, and what it hands over to jobs."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.experiment import identity
from xrgs.safeio.confined import RootMissingError
from xrgs.sweep.session import HandOver, SweepSession

HandOverOf = Callable[..., HandOver]


def signed_by(session: SweepSession, **changes: object) -> SweepSession:
    """Return the session as that of another process."""
    file = session.folder.path / "sweep"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return SweepSession(session.folder.path)


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


def test_a_disk_too_full_for_the_reason_stops_the_jobs_all_the_same(session: SweepSession) -> None:
    (session.folder.path / "stopped").touch()
    assert session.stopped == f"{session.folder / 'stopped'} exists"


def test_a_session_whose_folder_is_gone_is_over_and_does_not_reappear(
    session: SweepSession, hand_over_of: HandOverOf
) -> None:
    assert session.exists
    path = session.folder.path
    path.rename(path.with_name("moved"))
    assert not session.exists
    assert session.stopped == f"{path} is no longer there"
    session.stop("a reason")
    with pytest.raises(RootMissingError):
        session.hand_over(hand_over_of())
    assert not path.exists()


def test_a_reason_that_can_not_be_read_now_stops_nothing(
    session: SweepSession, sick: Callable[[str, int], None]
) -> None:
    session.stop("enough\x1b[31m\nof it")
    sick("stopped", errno.EIO)
    assert str(session.stopped) == ""
    sick("", 0)
    assert str(session.stopped) == "enough [31m of it"


def test_something_else_with_the_name_of_the_reason_stops_the_jobs(session: SweepSession) -> None:
    (session.folder.path / "stopped").symlink_to("/etc/hostname")
    assert session.stopped == f"{session.folder / 'stopped'} exists"


def test_a_job_reads_what_the_plan_has_written(
    session: SweepSession, hand_over_of: HandOverOf
) -> None:
    written = replace(hand_over_of(seed=3), dead_locks=("a.0 x", "a.1 y"))
    cell_id = session.hand_over(written)
    read = session.read(cell_id)
    assert read == written
    assert read.cell_id == cell_id
    assert read.identity["variant"] == read.variant_id
    read.check_code()


def test_cells_that_differ_in_a_number_have_files_of_their_own(
    session: SweepSession, hand_over_of: HandOverOf
) -> None:
    ids = [session.hand_over(hand_over_of(seed=seed)) for seed in (0, 1)]
    assert [session.read(cell_id).config["seed"] for cell_id in ids] == [0, 1]


def remove(content: dict[str, Any], key: str) -> None:
    del content[key]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["identity"].update(seed=7), "its identity has the digest"),
        (lambda c: c["config"].update(seed=7), "seed differs between its config and its identity"),
        (lambda c: c["config"]["train"].update(steps=7), "train differs between"),
        (lambda c: c["config"]["splat"].update(sh_every=7), "splat differs between"),
        (lambda c: c["config"]["components"].clear(), "components differs between"),
        (lambda c: c["config"].update(fail_fast="no"), "fail_fast is neither"),
        (lambda c: c["config"].update(store=1), "path of its store"),
        (lambda c: c["config"]["limits"].update(minutes="1"), "limit is not a number"),
        (lambda c: c["config"]["limits"].update(memory_gb=True), "limit is not a number"),
        (lambda c: remove(c, "name"), "KeyError"),
        (lambda c: c.update(config=[]), "not what a plan writes"),
        (lambda c: c.update(identity="x"), "not what a plan writes"),
        (lambda c: c["identity"].update(code=[1]), "not what a plan writes"),
        (lambda c: c.update(dead_locks=[1]), "dead locks are not text"),
        (lambda c: c.update(dead_locks=1), "not what a plan writes"),
        (lambda c: remove(c["config"], "limits"), "KeyError"),
    ],
)
def test_a_hand_over_that_somebody_changed_is_refused(
    session: SweepSession,
    hand_over_of: HandOverOf,
    change: Callable[[dict[str, Any]], object],
    message: str,
) -> None:
    cell_id = session.hand_over(hand_over_of())
    file = session.folder.path / "cells" / f"{cell_id}.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    with pytest.raises(XrgsError, match=message) as caught:
        session.read(cell_id)
    assert str(file) in str(caught.value)


def test_a_variant_outside_of_the_store_is_refused(
    session: SweepSession, hand_over_of: HandOverOf
) -> None:
    """A hand-over is consistent in itself, and made by somebody else."""
    made = hand_over_of()
    forged = HandOver(made.name, made.config, dict(made.identity) | {"variant": "../../elsewhere"})
    with pytest.raises(XrgsError, match="id of its variant"):
        session.read(session.hand_over(forged))


@pytest.mark.parametrize("content", ["", "{", "[]", "1" * 10_000, '{"a": NaN}'])
def test_a_file_that_is_no_hand_over_is_named(session: SweepSession, content: str) -> None:
    (session.folder.path / "cells" / "a.json").write_text(content)
    with pytest.raises(XrgsError, match=r"a\.json"):
        session.read("a")


@pytest.mark.parametrize("cell_id", ["absent", "../sweep", ""])
def test_a_cell_that_was_not_handed_over_is_named(session: SweepSession, cell_id: str) -> None:
    with pytest.raises(XrgsError, match=r"absent\.json.*hydra\.sweep\.dir|is not the id of a cell"):
        session.read(cell_id)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"splat/densify.py": "0"}, r"1 files differ \(splat/densify.py\)"),
        ({"splat/of_then.py": "0"}, r"1 files differ \(splat/of_then.py\)"),
        (
            dict.fromkeys(("splat/a.py", "splat/b.py", "splat/c.py", "splat/d.py"), "0"),
            r"4 files differ \(splat/a.py, splat/b.py, splat/c.py, ...\)",
        ),
    ],
)
def test_other_code_than_the_planned_one_is_refused(
    session: SweepSession, hand_over_of: HandOverOf, changes: dict[str, str], named: str
) -> None:
    made = hand_over_of()
    planned = dict(made.identity) | {"code": made.identity["code"] | changes}
    cell_id = session.hand_over(HandOver(made.name, made.config, planned))
    with pytest.raises(XrgsError, match=named) as caught:
        session.read(cell_id).check_code()
    assert cell_id in str(caught.value)
    assert "Install the same version" in str(caught.value)


def test_code_that_is_edited_while_a_sweep_runs_is_noticed(
    hand_over_of: HandOverOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The digests that this process has computed for its plan are not trusted."""
    made = hand_over_of()
    edited = dict(identity.training_code("torch")) | {"splat/densify.py": "edited"}
    monkeypatch.setattr(identity, "source_digests", lambda *_: edited)
    assert identity.training_code("torch") != edited
    with pytest.raises(XrgsError, match=r"splat/densify\.py"):
        made.check_code()


def test_a_job_on_a_machine_of_other_arithmetic_is_refused(
    hand_over_of: HandOverOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = hand_over_of()
    made.check_code()
    monkeypatch.setattr("xrgs.sweep.session.arithmetic", lambda _: "no-fma")
    with pytest.raises(XrgsError, match=r"planned with the arithmetic .* this machine has no-fma"):
        made.check_code()
