"""Tests of `xrgs-report`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from xrgs.cli.report import report
from xrgs.report import Design
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.store import Store

RunCommand = Callable[..., tuple[int, str, str]]
SCENE = "-部屋 🙂 {it's} 50%=#1; é, a"


def test_the_sweeps_are_listed(call_command: RunCommand, tmp_path: Path) -> None:
    store = Store(tmp_path / "s")
    store.prepare()
    sweep = store.write_sweep(["+ablation=mip"], [])
    code, out, err = call_command("report", "list", "--store", "s")
    assert code == 0, err
    assert sweep in out


@pytest.mark.slow
def test_a_report_has_the_pictures_the_base_and_the_outcomes_that_are_named(
    call_command: RunCommand, store: Path, tmp_path: Path
) -> None:
    """This store has one replicate, so that its report has no verdict and explains none."""
    out, record = tmp_path / "out", Store(store).sweep_record()
    named_oddly = [msgspec.structs.replace(row, scene=SCENE) for row in record.cells]
    Store(store).write_sweep(["named oddly"], named_oddly)
    arguments = ("report", "--store", str(store), "--out", str(out))
    code, printed, err = call_command(*arguments, "--pictures", "none", "--against", "consistency")
    assert code == 0, err
    assert "baseline against consistency" in printed
    assert not list((out / "figures").iterdir())
    named = ("--outcomes", "lpips", "ssim", "--headline", "consistency", "--margin-lpips", "7")
    picture = f"{for_file_name(SCENE)}--consistency--training"
    code, printed, err = call_command(*arguments, *named, "--pictures", picture)
    assert code == 0, err
    assert "consistency against baseline" in printed
    assert "one replicate: no interval" in printed
    (file,) = (out / "figures").iterdir()
    assert file.stem == picture
    assert picture.isascii()
    assert f"](figures/{file.name})" in (out / "table.md").read_text()
    for words, message in (
        ("--pictures gone", "there is no picture of that name; choose from: "),
        ("--against gone", "the sweep has no such label; choose from: baseline, consistency"),
        ("--outcomes lpips_vgg", "these cells have no such metric; choose from: training_time_s"),
        ("--outcomes nice", "these cells have no such metric; choose from: "),
    ):
        code, _, err = call_command(*arguments, *words.split())
        assert code == 1
        assert f"{words}: {message}" in err


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
    assert err.rstrip().endswith("none has a scene with this name; xrgs-report list has all")


def test_a_margin_that_is_no_size_is_refused(call_command: RunCommand) -> None:
    for words in ("--margin-psnr -0.1", "--margin-lpips nan", "--margin-psnr inf"):
        code, _, err = call_command("report", *words.split())
        assert code == 1
        assert f"{words}: must be a number of at least 0" in err
