"""The benchmark of the store itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.bench import scale
from xrgs.errors import XrgsError


def test_every_command_is_timed_over_cells_that_count_as_done(tmp_path: Path) -> None:
    found = scale.measure(12, tmp_path)
    assert found["cells"] == 10
    commands = found["commands"]
    assert len({row["command"] for row in commands}) == len(commands) == 5
    assert all(row["seconds"] > 0 and row["ms_per_cell"] > 0 for row in commands)
    assert found["inodes"] - found["files"] == 2  # the cell's folder, and its renders'
    assert all(size > 0 for size in found["bytes"].values())
    assert "10 cells; one is 11 files, 13 inodes" in scale.text(found)
    assert not list(tmp_path.iterdir())


def test_too_few_cells_are_refused(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match="store_cells=4"):
        scale.measure(4, tmp_path)
