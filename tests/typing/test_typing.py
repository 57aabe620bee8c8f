"""A user's type checker sees the types of the public API, through `py.typed`."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import shutil
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
    # From an empty folder, so that the installed package is found and not the checkout. mypy does
    # not see an editable installation, whose source it is given instead.
    installed = Path(xrgs.__file__).parents[1]
    source = {} if installed.name == "site-packages" else {"MYPYPATH": str(installed)}
    options = ["--strict", "--config-file=", "--follow-imports=silent", "--no-error-summary"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(CORRECT), str(WRONG)],
        cwd=tmp_path,
        env=os.environ | source,
        capture_output=True,
        text=True,
        check=False,
    )
    out = done.stdout
    assert done.stderr == ""
    found = re.findall(r"^(\S+?):(\d+): error: .*\[([a-z-]+)\]$", out, flags=re.MULTILINE)
    assert len(found) == out.count(": error: "), out
    assert {Path(file).name for file, _, _ in found} == {WRONG.name}, out
    assert {(int(line), code) for _, line, code in found} == expected_errors(), out
    assert len(expected_errors()) == 9


@pytest.mark.slow
def test_every_method_of_a_path_that_reaches_the_disk_is_refused_in_the_package(
    tmp_path: Path,
) -> None:
    # A copy of the plugin takes the folder `xrgs` beside it for the package. An editable
    # installation is not seen by mypy, see above.
    installed = Path(xrgs.__file__).parents[1]
    package = {} if installed.name == "site-packages" else {"MYPYPATH": str(installed)}
    plugin = tmp_path / "tests" / "typing" / "file_access.py"
    source = tmp_path / "xrgs" / "wrong_files.py"
    for folder in (plugin.parent, source.parent):
        folder.mkdir(parents=True)
    shutil.copy(FOLDER / plugin.name, plugin)
    shutil.copy(FOLDER / source.name, source)
    (tmp_path / "mypy.ini").write_text(f"[mypy]\nplugins = {plugin}\n")
    options = ["--strict", "--config-file=mypy.ini", "--follow-imports=silent"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(source)],
        cwd=tmp_path,
        env=os.environ | package,
        capture_output=True,
        text=True,
        check=False,
    )
    found: dict[int, list[str]] = {}
    pattern = r":(\d+): error: Path\.(\w+) in wrong_files: use ConfinedPath"
    for number, method in re.findall(pattern, done.stdout):
        found.setdefault(int(number), []).append(method)
    lines = enumerate(source.read_text(encoding="utf-8").splitlines(), start=1)
    marks = ((number, line.partition("# refused: ")[2]) for number, line in lines)
    expected = {number: methods.split(", ") for number, methods in marks if methods}
    assert found == expected, done.stdout + done.stderr
    assert sum(map(len, found.values())) == done.stdout.count(": error: "), done.stdout


def test_every_exception_to_the_rule_for_paths_is_needed() -> None:
    spec = importlib.util.spec_from_file_location("file_access", FOLDER / "file_access.py")
    assert spec is not None
    assert spec.loader is not None
    plugin = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(plugin)
    for module, (methods, _) in plugin.ALLOWED.items():
        tree = ast.parse((Path(xrgs.__file__).parent / f"{module}.py").read_text(encoding="utf-8"))
        used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert set(methods.split()) <= used, module
