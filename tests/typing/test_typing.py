"""A user's type checker sees the types of the public API, through `py.typed`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mypy import api

FOLDER = Path(__file__).parent
CORRECT, WRONG = FOLDER / "correct_use.py", FOLDER / "wrong_use.py"


def expected_errors() -> set[tuple[int, str]]:
    """Line and code of each error that `wrong_use.py` announces."""
    lines = enumerate(WRONG.read_text(encoding="utf-8").splitlines(), start=1)
    marks = ((number, re.search(r"# error: ([a-z-]+)$", line)) for number, line in lines)
    return {(number, mark[1]) for number, mark in marks if mark}


@pytest.mark.slow
def test_correct_use_passes_and_each_wrong_use_is_found(tmp_path: Path) -> None:
    options = ["--strict", "--config-file=", f"--cache-dir={tmp_path}", "--no-error-summary"]
    out, err, _ = api.run([*options, str(CORRECT), str(WRONG)])
    assert err == ""
    found = re.findall(r"^(\S+?):(\d+): error: .*\[([a-z-]+)\]$", out, flags=re.MULTILINE)
    assert len(found) == out.count(": error: "), out
    assert {Path(file).name for file, _, _ in found} == {WRONG.name}, out
    assert {(int(line), code) for _, line, code in found} == expected_errors(), out
    assert len(expected_errors()) == 9
