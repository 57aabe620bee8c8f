"""The installed package has every file of the checkout, and the native backend."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from xrgs.config import CONF_DIR
from xrgs.splat.backend import REQUIRE_NATIVE, resolve_backend

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(("name", "inside"), [("conf", "."), ("sweeps", "sweeps")])
def test_every_config_file_is_installed(name: str, inside: str) -> None:
    installed = CONF_DIR / inside if CONF_DIR != ROOT / "conf" else ROOT / name
    files = sorted(file.relative_to(ROOT / name) for file in (ROOT / name).rglob("*.yaml"))
    assert len(files) >= 2
    for file in files:
        assert (installed / file).read_bytes() == (ROOT / name / file).read_bytes()


@pytest.mark.skipif(os.environ.get(REQUIRE_NATIVE) != "1", reason=f"{REQUIRE_NATIVE} is not 1")
def test_the_native_backend_is_the_one_in_use() -> None:
    assert resolve_backend("auto") == "native"
