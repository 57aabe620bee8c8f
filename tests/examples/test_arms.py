"""`examples/arms`: installed beside xrgs, swept, edited, and trained again."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "arms"
SOURCE = "xrgs_arms/skip_backward.py"
NAME = "skip_backward"
#: The settings of the ablation of this name, on the command line.
SETTINGS = (f"+components.plugins.{NAME}.share=0.5", f"+components.plugins.{NAME}.begin=15000")
CELL = ("scene=motorcycle", "preset=smoke", "train.steps=4", "threads=1", "store=s")

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Installed:
    """The example, installed in a folder of its own."""

    folder: Path
    """Where the commands run; their store is `s`."""
    site: Path
    """The folder of the installed package, for PYTHONPATH."""
    run_command: Callable[..., tuple[int, str, str]]

    def sweep(self, *arguments: str, installed: bool = True) -> tuple[int, str, str]:
        """Exit code, stdout and stderr of `xrgs-sweep`."""
        path = os.pathsep.join(filter(None, [str(self.site), os.environ.get("PYTHONPATH", "")]))
        environment = {"PYTHONPATH": path} if installed else {}
        return self.run_command("sweep", self.folder, *arguments, **environment)

    def cell(self) -> Path:
        """The folder of the one cell with the arm."""
        (folder,) = (
            file.parent
            for file in (self.folder / "s" / "cells").glob("*/identity.json")
            if "plugins" in json.loads(file.read_text())["components"]
        )
        return folder


@pytest.fixture(scope="module")
def example(
    tmp_path_factory: pytest.TempPathFactory, run_command: Callable[..., tuple[int, str, str]]
) -> Installed:
    folder = tmp_path_factory.mktemp("example")
    # From a copy: pip may leave files in the folder that it builds.
    source = shutil.copytree(EXAMPLE, folder / "arms")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-deps"]
    # Without build isolation, which would download the build backend: it is a test dependency.
    target = ["--no-build-isolation", "--no-index", "--target", str(folder / "site")]
    subprocess.run([*pip, *target, str(source)], check=True, capture_output=True)
    return Installed(folder, folder / "site", run_command)


@pytest.fixture(scope="module")
def swept(example: Installed, smoke_variants: Path) -> tuple[int, str, str]:
    """A sweep with the example's own ablation file."""
    shutil.copytree(smoke_variants, example.folder / "s" / "variants")
    conf = ("--config-dir", str(example.folder / "arms" / "conf"))
    return example.sweep(*conf, f"+ablation={NAME}", *CELL)


def test_the_sweep_ends_with_a_table_of_the_component(swept: tuple[int, str, str]) -> None:
    code, out, err = swept
    assert code == 0, err
    assert out.startswith(f"{NAME} against baseline")


def test_the_component_is_in_the_history(example: Installed, swept: tuple[int, str, str]) -> None:
    with (example.cell() / "history.csv").open() as file:
        *_, third, last = csv.DictReader(file)
    # Two steps after densification, on views that had no such step before: none is skipped.
    assert [{row[f"{NAME}.{tag}"] for tag in ("HR", "LR")} for row in (third, last)] == [
        {"", "0.0"},
        {"", "0.0"},
    ]


def test_a_plan_names_what_is_not_installed(
    example: Installed, swept: tuple[int, str, str]
) -> None:
    code, _, err = example.sweep(*SETTINGS, *CELL, "dry_run=true", installed=False)
    assert code == 1
    assert f"components.plugins.{NAME}: no installed package offers" in err


def test_an_edit_of_the_source_is_another_cell(
    example: Installed, swept: tuple[int, str, str]
) -> None:
    def planned() -> str:
        """The id of the cell in the plan, by its settings on the command line."""
        code, out, err = example.sweep(*SETTINGS, *CELL, "dry_run=true")
        assert code == 0, err
        (line,) = (line for line in (out + err).splitlines() if f"plugins.{NAME}" in line)
        (found,) = re.findall(r"\b[0-9a-f]{16}\b", line)
        return str(found)

    before = example.cell().name
    source = example.site / SOURCE
    text = source.read_text()
    try:
        source.write_text(f"{text}\n# words\n")
        assert planned() == before  # whichever way it is switched on
        source.write_text(f"{text}\nCODE = 1\n")
        assert planned() != before
    finally:
        source.write_text(text)


def test_it_is_trained_again_only_where_it_is_named(
    example: Installed, swept: tuple[int, str, str]
) -> None:
    """A store must not decide which installed package is imported."""
    rerun = (f"rerun={example.cell()}", "out=again")
    code, _, err = example.sweep(*rerun)
    assert code == 1
    assert f"add plugins={NAME}" in err
    assert not (example.folder / "again").exists()
    code, out, err = example.sweep(*rerun, f"plugins={NAME}")
    assert code == 0, err
    assert out.startswith("the same, bit for bit")
