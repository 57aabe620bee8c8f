"""Commands on hostile stores; `python -m tests.hostile.run` runs and prints the same."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hostile.themes import THEMES

ROOT = Path(__file__).parents[2]
#: The package under test is the one that is installed, not the source beside the tests.
_START = (
    f"import sys; sys.path.append({str(ROOT)!r}); "
    "from tests.hostile.run import main; sys.exit(main(sys.argv[1:]))"
)
#: One case of each theme whose commands take less than a second together.
_FAST = ("words/reason of a failure", "counts/summary NaN", "links/pipe as status.json")


def run(tmp_path: Path, *arguments: str) -> list[dict[str, str]]:
    """Run cases in a process of its own, which must have no threads; return the table's rows."""
    table = tmp_path / "table.csv"
    command = [sys.executable, "-P", "-c", _START, *arguments, "--out", str(table)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert table.exists(), done.stdout + done.stderr
    with table.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def not_ok(rows: list[dict[str, str]]) -> list[str]:
    return [
        f"{row['theme']}/{row['case']} {row['command']}: {row['verdict']}"
        for row in rows
        if row["verdict"] != "ok"
    ]


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("theme", THEMES)
def test_commands_withstand_every_hostile_store(theme: str, tmp_path: Path) -> None:
    rows = run(tmp_path, "--theme", theme)
    assert {row["case"] for row in rows} == set(THEMES[theme])
    assert not not_ok(rows), "\n".join(not_ok(rows))


@pytest.mark.slow
def test_commands_withstand_a_store_of_each_theme(tmp_path: Path) -> None:
    names = [f"{theme}/{next(iter(cases))}" for theme, cases in THEMES.items()]
    rows = run(tmp_path, *(word for name in names for word in ("--case", name)))
    assert {row["theme"] for row in rows} == set(THEMES)
    assert not not_ok(rows), "\n".join(not_ok(rows))


def test_commands_withstand_some_hostile_stores(tmp_path: Path) -> None:
    rows = run(tmp_path, *(word for name in _FAST for word in ("--case", name)))
    assert len({row["case"] for row in rows}) >= len(_FAST)
    assert not not_ok(rows), "\n".join(not_ok(rows))
