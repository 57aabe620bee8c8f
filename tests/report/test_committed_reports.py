"""Commands of the committed reports make the committed tables again, from the committed packs.

Of a table every number must come out as it is printed, in each of its sections. Of a CSV file every
text must, and of a number twelve digits: the last ones differ between processors. What is left out
is of the installed code and not of the study: the legend, warnings, and which scores are stale. No
pictures are made: a pack has no renders. Four small studies are for the code, whose numbers all
studies have; the others show that their tables are still those of their packs.
"""

from __future__ import annotations

import csv
import re
import shlex
import tarfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from xrgs.report import collect, page

RunCommand = Callable[..., tuple[int, str, str]]

REPORTS = Path(__file__).parents[2] / "reports"
PACKS = sorted(REPORTS.rglob("store.tar.xz"))
SMALL = {"captures", "embedded", "fast", "trainer"}
#: Without the race, whose table is not of `xrgs-report`: tests/bench/test_race.py makes it again.
STUDIES = [
    pytest.param(study, marks=() if study in SMALL else pytest.mark.exhaustive)
    for study in sorted({pack.parent.relative_to(REPORTS).parts[0] for pack in PACKS} - {"race"})
]
NUMBER = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?")


def commands(notes: Path) -> list[dict[str, list[str]]]:
    """Return the `xrgs-report` commands of a page: each a list of values by option."""
    blocks = re.findall(r"^ *```sh\n(.*?)^ *```", notes.read_text(), re.MULTILINE | re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    found = []
    for line in lines:
        if line.strip().startswith("xrgs-report "):
            options: dict[str, list[str]] = {}
            for word in shlex.split(line, comments=True)[1:]:
                if word.startswith("--"):
                    values = options.setdefault(word, [])
                else:
                    values.append(word)
            found.append(options)
    return found


def numbers(table: Path) -> dict[str, list[str]]:
    """Return the numbers of each section of a `table.md` before its pictures, by the title."""
    text = table.read_text().split("\n![", 1)[0]
    sections = (section.split("\n", 1) for section in text.split("\n### "))
    return {
        title: NUMBER.findall(re.sub(r"^\*\*.*", "", body, flags=re.MULTILINE))
        for title, body in sections
        if title != "How to read the tables"
    }


def rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file without `stale`, and twelve digits of each decimal number."""
    with file.open(newline="") as stream:
        found = list(csv.DictReader(stream))
    return [
        {name: _twelve_digits(text) for name, text in row.items() if name != "stale"}
        for row in found
    ]


def _twelve_digits(text: str) -> str:
    return f"{float(text):.12g}" if re.fullmatch(r"-?\d+\.\d+(e[-+]\d+)?", text) else text


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_the_printed_commands_make_the_committed_tables(
    study: str, call_command: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "write_document", lambda *_, **__: None)  # half of the time
    # Commands of a study read the same cells.
    monkeypatch.setattr(collect, "_read_cell", cache(collect._read_cell))
    for pack in sorted((REPORTS / study).rglob("store.tar.xz")):
        with tarfile.open(pack) as archive:
            archive.extractall(tmp_path, filter="data")
    compared: set[Path] = set()
    for options in commands(REPORTS / study / "NOTES.md"):
        folder = Path(*options.get("--out", []))
        if "--external" in options:  # the renders of another program are in no pack
            compared |= set((REPORTS.parent / folder).glob("cells.csv"))
            continue
        if "--out" not in options:  # nothing is committed of it: its sweeps are there
            for sweep in options["--sweep"]:
                assert (tmp_path / "xrgs-store" / "sweeps" / f"{sweep}.json").is_file()
            continue
        options |= {"--pictures": ["none"]}
        code, _, err = call_command("report", *(w for o, v in options.items() for w in (o, *v)))
        assert code == 0, err
        (tmp_path / folder / "table.tex").unlink()  # not to be compiled with those of other tests
        for made in (tmp_path / folder).iterdir():
            committed = REPORTS.parent / folder / made.name
            read = {".md": numbers, ".csv": rows}.get(made.suffix)
            if read and committed.exists():
                assert read(made) == read(committed), committed
                compared.add(committed)
    names = ("table.md", "cells.csv")
    assert {file for name in names for file in (REPORTS / study).rglob(name)} <= compared
