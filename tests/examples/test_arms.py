"""`examples/arms`: installed beside xrgs, swept, and trained again."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import xrgs.report

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "arms"
NAME = "skip_backward"


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_it_is_swept_and_trained_again_only_where_it_is_named(
    tmp_path: Path,
    smoke_variants: Path,
    sweep_here: Callable[..., tuple[int, str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # From a copy: pip may leave files in the folder that it builds.
    source, site = shutil.copytree(EXAMPLE, tmp_path / "arms"), tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-deps"]
    # Without build isolation, which would download the build backend: it is a test dependency.
    target = ["--no-build-isolation", "--no-index", "--target", str(site)]
    subprocess.run([*pip, *target, str(source)], check=True, capture_output=True)
    shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(xrgs.report, "build", lambda *_: SimpleNamespace(text=""))
    code, _, err = sweep_here(
        *("--config-dir", str(source / "conf"), f"+ablation={NAME}"),
        *("scene=motorcycle", "preset=smoke", "train.steps=4", "threads=1", "store=s"),
        "baseline=false",
    )
    assert code == 0, err
    (cell,) = (tmp_path / "s" / "cells").iterdir()
    assert NAME in json.loads((cell / "identity.json").read_text())["components"]["plugins"]
    with (cell / "history.csv").open() as file:
        *_, third, last = csv.DictReader(file)
    # Two steps after densification, on views that had no such step before: none is skipped.
    assert [{row[f"{NAME}.{tag}"] for tag in ("HR", "LR")} for row in (third, last)] == [
        {"", "0.0"},
        {"", "0.0"},
    ]
    # A store must not decide which installed package is imported.
    rerun = (f"rerun={cell}", "out=again")
    code, _, err = sweep_here(*rerun)
    assert code == 1
    assert f"add plugins={NAME}" in err
    assert not (tmp_path / "again").exists()
    code, out, err = sweep_here(*rerun, f"plugins={NAME}")
    assert code == 0, err
    assert out.startswith("the same, bit for bit")
