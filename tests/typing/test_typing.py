"""A user's type checker sees the types of the public API, through `py.typed`."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import xrgs

FOLDER = Path(__file__).parent
CORRECT, WRONG = FOLDER / "correct_use.py", FOLDER / "wrong_use.py"


def expected_errors() -> set[tuple[int, str]]:
    """Line and code of each error that `wrong_use.py` announces."""
    lines = enumerate(WRONG.read_text(encoding="utf-8").splitlines(), start=1)
    marks = ((number, re.search(r"# error: ([a-z-]+)$", line)) for number, line in lines)
    return {(number, mark[1]) for number, mark in marks if mark}


@pytest.mark.slow
def test_correct_use_passes_and_each_wrong_use_is_found(tmp_path: Path) -> None:
    # mypy does not see an editable installation: it is given the source. It runs in an empty
    # folder, so that it finds the installed package and no checkout.
    installed = Path(xrgs.__file__).parents[1]
    package = {} if installed.name == "site-packages" else {"MYPYPATH": str(installed)}
    options = ["--strict", "--config-file=", "--follow-imports=silent"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(CORRECT), str(WRONG)],
        cwd=tmp_path,
        env=os.environ | package,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    found = re.findall(r"^(\S+?):(\d+): error: .*\[([a-z-]+)\]$", done.stdout, flags=re.MULTILINE)
    assert len(found) == done.stdout.count(": error: "), done.stdout
    assert {Path(file).name for file, _, _ in found} == {WRONG.name}, done.stdout
    assert {(int(line), code) for _, line, code in found} == expected_errors(), done.stdout
    assert len(expected_errors()) == 9
