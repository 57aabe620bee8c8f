"""Reports of failed scenes, whoever wrote them."""

from __future__ import annotations

import json
from pathlib import Path

from xrgs.capture.failures import failed_scenes


def test_readable_reports_are_listed_by_key_and_others_left_out(tmp_path: Path) -> None:
    for key, report in {
        "b": {"scene": "leaves", "reason": "too few views"},
        "a": {"scene": "flat", "reason": "no points"},
        "c": {"scene": "no reason"},
        "d": [],
    }.items():
        (tmp_path / f"failed-{key}").mkdir()
        (tmp_path / f"failed-{key}" / "report.json").write_text(json.dumps(report))
    (tmp_path / "failed-e").mkdir()
    (tmp_path / "frozen").mkdir()
    expected = {"a": ("flat", "no points"), "b": ("leaves", "too few views")}
    assert failed_scenes(tmp_path) == expected
    assert list(failed_scenes(tmp_path)) == ["a", "b"]
    assert failed_scenes(tmp_path, "b") == {"b": ("leaves", "too few views")}
    assert failed_scenes(tmp_path, "f") == {}
