"""Tests of `xrgs-status`; what it reads has tests of its own."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from xrgs.cli import status
from xrgs.experiment.store import Store


def test_it_prints_what_a_store_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Store(tmp_path / "s").prepare()
    monkeypatch.setattr(sys, "argv", ["xrgs-status", f"store={tmp_path / 's'}"])
    status.main()
    assert f"store {tmp_path / 's'}: 0 cells" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("store=gone", "store=gone is not a store"),
        ("verify=true", "verify"),
        ("stroe=s", "stroe"),
    ],
)
def test_bad_input_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, argument: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["xrgs-status", argument])
    with pytest.raises(SystemExit) as end:
        status.main()
    assert str(end.value.code).startswith("xrgs-status: ")
    assert message in str(end.value.code)
