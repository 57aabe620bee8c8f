"""The benchmark of the store itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.bench import scale
from xrgs.errors import XrgsError


def test_every_command_is_timed_over_cells_that_count_as_done(tmp_path: Path) -> None:
    rows = scale.measure(12, tmp_path)
    assert [row["cells"] for row in rows] == [10] * len(rows)
    assert len({row["command"] for row in rows}) == len(rows) == 5
    assert all(row["seconds"] > 0 for row in rows)
    assert "10 cells" in scale.text(rows)
    assert not list(tmp_path.iterdir())


def test_too_few_cells_are_refused(tmp_path: Path) -> None:
    with pytest.raises(XrgsError, match="store_cells=4"):
        scale.measure(4, tmp_path)
