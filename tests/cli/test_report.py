"""Tests of `xrgs-report`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from xrgs.cli import report
from xrgs.experiment.store import Store

RunCommand = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
def test_the_report_is_rebuilt_byte_for_byte(
    run_command: RunCommand, store: Path, contents: Callable[[Path], dict[str, str]]
) -> None:
    before = contents(store / "reports")
    shutil.rmtree(store / "reports")
    code, out, err = run_command("report", store.parent, "store=s")
    assert code == 0, err
    assert "consistency against baseline" in out
    assert contents(store / "reports") == before


@pytest.mark.parametrize("words", [("list", "store={}"), ("store={}", "list")])
def test_the_sweeps_are_listed_wherever_the_word_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: Any
) -> None:
    store = Store(tmp_path)
    store.prepare()
    sweep = store.write_sweep(["+ablation=mip"], [])
    monkeypatch.setattr(sys, "argv", ["xrgs-report", *(word.format(tmp_path) for word in words)])
    report.main()
    assert sweep in capsys.readouterr().out


@pytest.mark.slow
def test_a_report_has_the_pictures_that_are_named(
    run_command: RunCommand, store: Path, tmp_path: Path
) -> None:
    for pictures, drawn in (("none", []), ("motorcycle--consistency", ["motorcycle--consistency"])):
        out = tmp_path / pictures
        code, _, err = run_command(
            "report", store.parent, "store=s", f"out={out}", f"pictures={pictures}"
        )
        assert code == 0, err
        assert [file.stem for file in (out / "figures").iterdir()] == drawn
    code, _, err = run_command("report", store.parent, "store=s", f"out={out}", "pictures=gone")
    assert code == 1
    assert "pictures=gone" in err
    assert "motorcycle--consistency--training" in err


@pytest.mark.slow
def test_a_report_against_another_label_or_none_there_is(
    run_command: RunCommand, store: Path
) -> None:
    arguments = ("report", store.parent, "store=s", "pictures=none")
    code, out, err = run_command(*arguments, "against=consistency")
    assert code == 0, err
    assert "baseline against consistency" in out
    assert "change from consistency, %" in out
    code, _, err = run_command(*arguments, "against=gone")
    assert code == 1
    assert "against=gone: the sweep has no such label; choose from: baseline, consistency" in err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [(["store=gone"], "gone"), (["stroe=x"], "stroe"), (["sweep=nope", "store=s"], "nope")],
)
def test_a_report_that_can_not_be_made_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], named: str
) -> None:
    (tmp_path / "s" / "sweeps").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["xrgs-report", *arguments])
    with pytest.raises(SystemExit, match=named) as end:
        report.main()
    assert str(end.value.code).startswith("xrgs-report: ")
