"""Tests of the benchmark of a store and of what a job costs before it trains."""

from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.bench import scale
from xrgs.errors import XrgsError


@pytest.mark.slow
def test_every_command_is_measured_over_cells_that_count_as_done(tmp_path: Path) -> None:
    result = scale.measure(12, tmp_path)
    assert result["cells"] == 10
    commands = result["commands"]
    assert len({row["command"] for row in commands}) == len(commands) == 5
    assert all(row["seconds"] > 0 and row["ms_per_cell"] > 0 for row in commands)
    assert result["inodes"] - result["files"] == 2  # the cell's folder, and its renders'
    assert all(size > 0 for size in result["bytes"].values())
    assert "10 cells; one is 11 files, 13 inodes" in scale.text(result)
    assert list(result["job"]) == [
        "job: read and verify the hand-over",
        "plan: write the hand-over",
        "plan: hash 100 photographs, once",
    ]
    assert all(milliseconds > 0 for milliseconds in result["job"].values())
    for what in result["job"]:
        assert what in scale.text(result)
    assert not list(tmp_path.iterdir())


def test_too_few_cells_are_refused(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match="store_cells=4"):
        scale.measure(4, tmp_path)
