"""Tests of `xrgs-report`."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.cli.report import report
from xrgs.report import Design
from xrgs.store.store import Store

RunCommand = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
def test_the_report_is_rebuilt_byte_for_byte(
    run_command: RunCommand, store: Path, contents: Callable[[Path], dict[str, str]]
) -> None:
    """By a process with other hashes, which order sets otherwise."""
    before = contents(store / "reports")
    shutil.rmtree(store / "reports")
    code, out, err = run_command("report", store.parent, "--store", "s")
    assert code == 0, err
    assert "consistency against baseline" in out
    assert contents(store / "reports") == before


def test_the_sweeps_are_listed(call_command: RunCommand, tmp_path: Path) -> None:
    store = Store(tmp_path / "s")
    store.prepare()
    sweep = store.write_sweep(["+ablation=mip"], [])
    code, out, err = call_command("report", "list", "--store", "s")
    assert code == 0, err
    assert sweep in out


@pytest.mark.slow
def test_a_report_has_the_pictures_that_are_named(
    forked_command: RunCommand, store: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ("report", store.parent, "--store", "s", "--out", str(out), "--pictures")
    for pictures, drawn in (("none", []), ("motorcycle--consistency", ["motorcycle--consistency"])):
        code, _, err = forked_command(*arguments, pictures)
        assert code == 0, err
        assert [file.stem for file in (out / "figures").iterdir()] == drawn
    code, _, err = forked_command(*arguments, "gone")
    assert code == 1
    assert "--pictures gone: there is no picture of that name" in err
    assert "motorcycle--consistency--training" in err


@pytest.mark.slow
def test_a_report_against_another_label_or_none_there_is(
    forked_command: RunCommand, store: Path
) -> None:
    arguments = ("report", store.parent, "--store", "s", "--pictures", "none")
    code, out, err = forked_command(*arguments, "--against", "consistency")
    assert code == 0, err
    assert "baseline against consistency" in out
    code, _, err = forked_command(*arguments, "--against", "gone")
    assert code == 1
    assert "--against gone: the sweep has no such label; choose from: baseline, consistency" in err


@pytest.mark.slow
def test_a_report_takes_outcomes_and_names_those_that_are_not_there(
    forked_command: RunCommand, store: Path
) -> None:
    """This store has one replicate, so that its report has no verdict and explains none."""
    arguments = ("report", store.parent, "--store", "s", "--pictures", "none")
    named = ("--outcomes", "lpips", "ssim", "--headline", "consistency", "--margin-lpips", "7")
    code, out, err = forked_command(*arguments, *named)
    assert code == 0, err
    assert "one replicate: no interval" in out
    code, _, err = forked_command(*arguments, "--outcomes", "nice")
    assert code == 1
    assert "--outcomes nice: there is no such metric; choose from: " in err


def test_the_margins_of_the_command_are_those_of_a_design() -> None:
    options = inspect.signature(report).parameters
    for name in ("margin_psnr", "margin_lpips"):
        assert options[name].default == getattr(Design, name)


def test_a_sweep_that_is_not_there_is_named(call_command: RunCommand, tmp_path: Path) -> None:
    (tmp_path / "s" / "sweeps").mkdir(parents=True)
    code, _, err = call_command("report", "--sweep", "nope", "--store", "s")
    assert code == 1
    assert err.startswith("xrgs-report: --store s is not a store")
    (tmp_path / "s" / "cells").mkdir()
    _, _, err = call_command("report", "--sweep", "nope", "--store", "s")
    assert err.startswith("xrgs-report: nope: no sweeps have such an id")
