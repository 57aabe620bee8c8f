"""The choice of a backend, and that the backends have the same functions."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import logging
from collections.abc import Callable, Iterator
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import get_args

import pytest

from xrgs.errors import XrgsError
from xrgs.splat import backend
from xrgs.splat.backend import (
    NATIVE_MODULE,
    REQUIRE_NATIVE,
    Operation,
    implementation,
    resolve_backend,
)
from xrgs.splat.settings import RasterSettings

Pretend = Callable[[bool], None]
OPERATIONS: tuple[Operation, ...] = get_args(Operation)


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pretend]:
    """Pretends that the extension was built or was not, whatever this machine has."""

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
        ("gsplat", False, "gsplat"),
    ],
)
def test_choice(
    built: Pretend, caplog: pytest.LogCaptureFixture, name: str, there: bool, expected: str
) -> None:
    built(there)
    assert resolve_backend(name) == expected
    assert not caplog.records


def test_fallback_says_so_once(built: Pretend, caplog: pytest.LogCaptureFixture) -> None:
    built(False)
    with caplog.at_level(logging.WARNING):
        assert [resolve_backend("auto") for _ in range(3)] == ["torch"] * 3
    assert implementation("loss", "auto").__name__ == "xrgs.splat.torch.loss"
    (record,) = caplog.records
    assert NATIVE_MODULE in record.getMessage()
    assert "\n" not in record.getMessage()


def test_what_was_asked_for_and_is_missing_is_named(
    built: Pretend, monkeypatch: pytest.MonkeyPatch
) -> None:
    built(False)
    for use in (resolve_backend, partial(implementation, "loss")):
        with pytest.raises(XrgsError, match=r"splat\.backend=native"):
            use("native")
    monkeypatch.setenv(REQUIRE_NATIVE, "1")
    with pytest.raises(XrgsError, match=REQUIRE_NATIVE):
        resolve_backend("auto")
    assert resolve_backend("torch") == "torch"
    with pytest.raises(ValueError, match="'cuda'"):
        resolve_backend("cuda")


@pytest.fixture
def gsplat_version(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str | None], None]]:
    """Pretends that a version of gsplat is installed, or none."""

    def pretend(version: str | None) -> None:
        def installed(name: str) -> str:
            assert name == "gsplat"
            if version is None:
                raise metadata.PackageNotFoundError
            return version

        backend._gsplat_version.cache_clear()
        monkeypatch.setattr(metadata, "version", installed)

    yield pretend
    backend._gsplat_version.cache_clear()


@pytest.mark.parametrize(
    ("version", "name", "alpha_max"),
    [
        ("1.5.3+pt24cu124", "1.5.3", 0.999),
        ("1.6.0", "1.6.0", 0.99),
        ("1.6", "1.6", 0.99),
    ],
)
def test_known_versions_of_gsplat(
    gsplat_version: Callable[[str | None], None], version: str, name: str, alpha_max: float
) -> None:
    gsplat_version(version)
    assert resolve_backend("gsplat") == "gsplat"
    assert backend.arithmetic("gsplat") == f"gsplat {name}"
    backend.check_raster("gsplat", RasterSettings(alpha_max=alpha_max))
    other = 0.99 if alpha_max == 0.999 else 0.999
    with pytest.raises(XrgsError, match=rf"alpha_max={other}: .*gsplat {name} have {alpha_max};"):
        backend.check_raster("gsplat", RasterSettings(alpha_max=other))
    backend.check_raster("native", RasterSettings(alpha_max=other))


@pytest.mark.parametrize("version", ["1.5.2", "1.60"])
def test_other_versions_of_gsplat_are_refused(
    gsplat_version: Callable[[str | None], None], version: str
) -> None:
    gsplat_version(version)
    with pytest.raises(
        XrgsError, match=rf"gsplat {version} is installed, and xrgs knows 1\.5\.3 and"
    ):
        resolve_backend("gsplat")


def test_gsplat_asked_for_and_missing(gsplat_version: Callable[[str | None], None]) -> None:
    gsplat_version(None)
    for use in (resolve_backend, backend.arithmetic, partial(implementation, "loss")):
        with pytest.raises(XrgsError, match=r"not installed: pip install 'xrgs\[gsplat\]'"):
            use("gsplat")


def test_all_but_the_renderer_of_gsplat_is_torchs(
    gsplat_version: Callable[[str | None], None],
) -> None:
    gsplat_version("1.6.0")
    for operation in set(OPERATIONS) - {"rasterizer"}:
        assert implementation(operation, "gsplat") is implementation(operation, "torch")
    assert backend.device("native") == backend.device("torch") == "cpu"


def test_every_module_of_the_backends_is_an_operation() -> None:
    folder = Path(backend.__file__).parent
    modules = {path.stem for path in (folder / "native").glob("*.py")}
    assert modules == {*OPERATIONS, "__init__", "arguments"}
    assert {path.stem for path in (folder / "gsplat").glob("*.py")} == {"rasterizer", "__init__"}
