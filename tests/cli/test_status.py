"""Tests of `xrgs-status`; what it reads has tests of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from xrgs.store.store import Store


def test_it_prints_what_a_store_holds(
    call_command: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    Store(tmp_path / "s").prepare()
    code, out, err = call_command("status", "--store", "s")
    assert code == 0, err
    assert "store s: 0 cells" in out
