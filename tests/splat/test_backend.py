import importlib.machinery
import importlib.util
import logging

import pytest

from xrgs.errors import XrgsError
from xrgs.splat import backend
from xrgs.splat.backend import NATIVE_MODULE, REQUIRE_NATIVE, resolve_backend


@pytest.fixture
def built(monkeypatch):
    """Says whether the extension is there, whatever this machine has."""

    def pretend(answer: bool) -> None:
        spec = importlib.machinery.ModuleSpec(NATIVE_MODULE, None) if answer else None
        monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec)

    monkeypatch.delenv(REQUIRE_NATIVE, raising=False)
    backend._warn_once.cache_clear()
    yield pretend
    backend._warn_once.cache_clear()


@pytest.mark.parametrize(
    ("name", "there", "expected"),
    [
        ("auto", True, "native"),
        ("native", True, "native"),
        ("torch", True, "torch"),
        ("torch", False, "torch"),
    ],
)
def test_choice(built, caplog, name, there, expected):
    built(there)
    assert resolve_backend(name) == expected
    assert not caplog.records


def test_fallback_says_so_once(built, caplog):
    built(False)
    with caplog.at_level(logging.WARNING):
        assert [resolve_backend("auto") for _ in range(3)] == ["torch"] * 3
    (record,) = caplog.records
    assert NATIVE_MODULE in record.getMessage()
    assert "\n" not in record.getMessage()


def test_native_asked_for_and_missing(built):
    built(False)
    with pytest.raises(XrgsError, match=r"splat\.backend=native"):
        resolve_backend("native")


def test_native_required_and_missing(built, monkeypatch):
    built(False)
    monkeypatch.setenv(REQUIRE_NATIVE, "1")
    with pytest.raises(XrgsError, match=REQUIRE_NATIVE):
        resolve_backend("auto")
    assert resolve_backend("torch") == "torch"


def test_unknown_name():
    with pytest.raises(ValueError, match="'cuda'"):
        resolve_backend("cuda")
