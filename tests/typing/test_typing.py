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
WRONG_FILES = FOLDER / "wrong_files.py"


def expected_errors() -> set[tuple[int, str]]:
    """Line and code of each error that `wrong_use.py` announces."""
    lines = enumerate(WRONG.read_text(encoding="utf-8").splitlines(), start=1)
    marks = ((number, re.search(r"# error: ([a-z-]+)$", line)) for number, line in lines)
    return {(number, mark[1]) for number, mark in marks if mark}


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What mypy says of correct use, of wrong use and of a module that reaches the disk."""
    folder = tmp_path_factory.mktemp("typing")
    # A copy of the plugin takes the folder `xrgs` beside it for the package.
    plugin = folder / "tests" / "typing" / "file_access.py"
    source = folder / "xrgs" / WRONG_FILES.name
    empty = folder / "empty"
    for parent in (plugin.parent, source.parent, empty):
        parent.mkdir(parents=True)
    shutil.copy(FOLDER / plugin.name, plugin)
    shutil.copy(WRONG_FILES, source)
    config = folder / "mypy.ini"
    config.write_text(f"[mypy]\nplugins = {plugin}\n")
    # From an empty folder, so that the installed package is found and not the checkout. mypy does
    # not see an editable installation, whose source it is given instead.
    installed = Path(xrgs.__file__).parents[1]
    package = {} if installed.name == "site-packages" else {"MYPYPATH": str(installed)}
    options = ["--strict", f"--config-file={config}", "--follow-imports=silent"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, str(CORRECT), str(WRONG), str(source)],
        cwd=empty,
        env=os.environ | package,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    return done.stdout


@pytest.mark.slow
def test_correct_use_passes_and_each_wrong_use_is_found(output: str) -> None:
    found = re.findall(r"^(\S+?):(\d+): error: .*\[([a-z-]+)\]$", output, flags=re.MULTILINE)
    assert len(found) == output.count(": error: "), output
    of_use = [row for row in found if Path(row[0]).name != WRONG_FILES.name]
    assert {Path(file).name for file, _, _ in of_use} == {WRONG.name}, output
    assert {(int(line), code) for _, line, code in of_use} == expected_errors(), output
    assert len(expected_errors()) == 9


@pytest.mark.slow
def test_every_method_of_a_path_that_reaches_the_disk_is_refused_in_the_package(
    output: str,
) -> None:
    found: dict[int, list[str]] = {}
    pattern = r":(\d+): error: Path\.(\w+) in wrong_files: use ConfinedPath"
    for number, method in re.findall(pattern, output):
        found.setdefault(int(number), []).append(method)
    lines = enumerate(WRONG_FILES.read_text(encoding="utf-8").splitlines(), start=1)
    marks = ((number, line.partition("# refused: ")[2]) for number, line in lines)
    expected = {number: methods.split(", ") for number, methods in marks if methods}
    assert found == expected, output
    assert sum(map(len, found.values())) == output.count(f"{WRONG_FILES.name}:"), output


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
