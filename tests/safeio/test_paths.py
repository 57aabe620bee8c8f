from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.safeio.paths import user_path


def test_home_folders_are_expanded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    assert user_path("~/scenes") == Path("/home/somebody/scenes")
    assert user_path("scenes/a~b") == Path("scenes/a~b")
    assert user_path("~nobody-of-this-name/x") == Path("~nobody-of-this-name/x")
