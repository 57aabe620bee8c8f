"""Digests of source code: words change none, and any change of the meaning does."""

from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.safeio.code import digest_files, meaning

PYTHON = """\
import math
def area(r, unit="m²"):
    return math.pi * r**2, unit
"""
SAME_PYTHON = '''\
"""The docstring of the module."""
from __future__ import annotations
from typing import TYPE_CHECKING
import math  # a comment
if TYPE_CHECKING:
    from pathlib import Path

def area(r, unit="m²"):
    """The docstring of a function, with "quotes" and é."""
    # A comment of its own.
    return math.pi * r**2, unit  # π
'''
CPP = 'int f() {\n  const char* s = "// no comment";\n  return 1\'000;\n}\n'
SAME_CPP = """\
// A file.
int f() {  // é
  const char* s = "// no comment";

  return 1'000; /* of
  lines */
}
"""


def test_words_do_not_count() -> None:
    assert meaning(SAME_PYTHON, ".py") == meaning(PYTHON, ".py")
    assert meaning(SAME_CPP, ".cpp").split() == meaning(CPP, ".cpp").split()
    assert meaning("a(b) # c\n", ".txt") == meaning("a(b)\n", ".txt")


@pytest.mark.parametrize(
    ("old", "new"), [("r**2", "r**3"), ("m²", "cm²"), ("import math", "import cmath as math")]
)
def test_any_other_change_counts(old: str, new: str) -> None:
    assert meaning(PYTHON.replace(old, new), ".py") != meaning(PYTHON, ".py")


@pytest.mark.parametrize(("old", "new"), [("// no", "// a"), ("1'000", "1'001"), ("int", "long")])
def test_any_other_change_of_cpp_counts(old: str, new: str) -> None:
    assert meaning(CPP.replace(old, new), ".cpp") != meaning(CPP, ".cpp")


def test_a_raw_string_of_cpp_is_no_comment() -> None:
    code = 'auto s = R"x(// kept "))x"; // cut\n'
    assert meaning(code, ".cpp") == 'auto s = R"x(// kept "))x";'


def test_a_digest_is_of_names_and_meaning_and_of_the_files_now(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    file.write_text(PYTHON, encoding="utf-8")
    first = digest_files({"a.py": file})
    assert len(first) == 16
    assert digest_files({"b.py": file}) != first
    file.write_text(SAME_PYTHON, encoding="utf-8")
    assert digest_files({"a.py": file}) == first
    file.write_text(PYTHON.replace("2", "3"), encoding="utf-8")
    assert digest_files({"a.py": file}) != first
    file.with_suffix(".bin").write_bytes(b"\xff")
    assert digest_files({"data": file.with_suffix(".bin")}) != first
