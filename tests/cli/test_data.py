"""Tests of `xrgs-data`: its commands, and what it refuses; downloads have their own tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import xrgs.report.variant
from xrgs.capture import variant
from xrgs.sweep.jobs import worker

XrgsData = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fetch"], "fetch: there is no such command; see xrgs-data --help"),
        (["download"], "download : the dataset must be one of llff"),
        (["download", "mnist"], "download mnist: the dataset must be one of llff"),
        (["download", "llff", "fern", "shape=x"], "shape"),
        (["lpips", "to=x"], "to=: lpips takes only from="),
        (["inspect"], "inspect: give a variant's folder, or scene=NAME"),
        (["inspect", "folder", "scene=x"], "inspect: give a variant's folder, or scene=NAME"),
        (["inspect", "scene=nope"], "scene=nope"),
        (["inspect", "gone"], "gone"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_named(xrgs_data: XrgsData, arguments: list[str], message: str) -> None:
    code, out, err = xrgs_data(*arguments)
    assert (code, out) == (1, "")
    assert err.startswith("xrgs-data: ")
    assert message in err


def test_help_lists_the_commands(xrgs_data: XrgsData) -> None:
    for arguments in ([], ["--help"], ["download", "-h"]):
        code, out, _ = xrgs_data(*arguments)
        assert code == 0
        assert all(f"xrgs-data {name}" in out for name in ("download", "lpips", "inspect"))


@pytest.mark.parametrize("built", [True, False])
def test_inspect_builds_a_variant_that_the_store_lacks(
    xrgs_data: XrgsData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built: bool
) -> None:
    jobs = []

    def build(job: str, request: dict[str, Any], *_: object) -> dict[str, Any]:
        jobs.append((job, request["conf"]["scene"]["kind"]))
        return {"variant": "k-1"}

    monkeypatch.setattr(worker, "run_in_child", build)
    monkeypatch.setattr(variant, "find", lambda *_: SimpleNamespace(id="k-1") if built else None)
    monkeypatch.setattr(xrgs.report.variant, "describe", lambda folder, out: f"{folder} {out}")
    code, out, err = xrgs_data("inspect", "scene=motorcycle", "store=s", "out=x.png")
    assert code == 0, err
    assert out.strip() == "s/variants/k-1 x.png"
    assert jobs == ([] if built else [("variant", "motorcycle")])
