"""Judges how a command behaved on a hostile store."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import stat
import unicodedata
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from tests.hostile.looks import Look
from tests.hostile.sandbox import Ended

MAX_CPU_S = 5.0
MAX_WALL_S = 30.0
MAX_RSS = 1 << 30
#: To verify a store is to read all of it.
MAX_CPU_GB_S = 4.0
#: Training a cell imports torch.
MAX_CPU_TRAINING_S = 30.0
#: Categories of characters that a terminal, an editor or a spreadsheet may obey.
_OBEYED = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
#: Our own changes end with an arrow, as `-50.00 ↑`.
_NUMBER = re.compile(r"[+-]?(\d[\d,]*(\.\d*)?|\.\d+)([eE][+-]?\d+)?( [↑↓=])?|[+-]?(inf|nan)")
#: What would be run or loaded where the page or the table is shown.
_ACTIVE = {
    "table.md": re.compile(
        r"(?<!\\)<(script|img|iframe)|(?<!\\)\]\((?!figures/)|(?<!\\)!\[[^\]]*\]\(http", re.I
    ),
    "table.tex": re.compile(r"\\(input|write|include|openout|catcode)\b"),
}


def verdicts(look: Look, ended: Ended) -> Iterator[str]:
    """Yield what is wrong with how a command ended and with what it printed."""
    text = ended.output.decode("utf-8", "replace")
    most = MAX_CPU_TRAINING_S if look.can_train else MAX_CPU_S + look.hashed_gb * MAX_CPU_GB_S
    if ended.hung or ended.cpu_s > most:
        yield "hang"
    elif ended.code < 0:
        yield f"signal {-ended.code}"
    elif ended.code not in ((0,) if look.succeeds else (0, 1, 2)):
        yield f"exit code {ended.code}"
    if "Traceback" in text:
        yield "traceback"
    if "MemoryError" in text or ended.peak_rss > MAX_RSS:
        yield "memory"
    if bad := obeyed(text):
        yield f"escapes ({bad})"
    if ended.hung:
        return
    flat = " ".join(text.split())
    yield from (f"file not named ({name})" for name in look.names if name not in flat)
    yield from (f"rest not shown ({shown})" for shown in look.shows if shown not in flat)


def obeyed(text: str) -> str:
    """Return the characters of a text that a terminal may obey, as code points."""
    found = {char for char in text if unicodedata.category(char) in _OBEYED and char not in "\n\t"}
    return " ".join(sorted(f"U+{ord(char):04X}" for char in found))


def report_verdicts(store: Path) -> Iterator[str]:
    """Yield what is wrong with the files of the reports in a store."""
    for file in sorted(_regular_files(store / "reports")):
        if obeyed(file.name):
            yield f"escapes (name of {file.name!a})"
        if file.suffix not in {".csv", ".md", ".tex", ".json"}:
            continue
        text = file.read_bytes().decode("utf-8", "replace")
        if bad := obeyed(text):
            yield f"escapes ({bad} in {file.name})"
        if file.suffix == ".csv" and (formula := _formula(text)):
            yield f"formula ({formula!a:.40} in {file.name})"
        active = _ACTIVE.get(file.name)
        if active and (found := active.search(text)):
            yield f"active ({found[0]!a:.40} in {file.name})"


def _formula(text: str) -> str:
    """Return a field of a CSV table that a spreadsheet would compute; empty if there is none."""
    csv.field_size_limit(max(len(text), csv.field_size_limit()))
    for row in csv.reader(io.StringIO(text, newline="")):
        for field in row:
            if field[:1] in {"=", "+", "-", "@", "\t", "\r"} and not _NUMBER.fullmatch(field):
                return field
    return ""


def snapshot(folder: Path, *left_out: Path) -> dict[str, str]:
    """Return a hash of everything in a folder, of the names as well as of the contents."""
    found = {}
    for entry in sorted(_walk(folder, left_out)):
        status = entry.lstat()
        content = ""
        if stat.S_ISREG(status.st_mode):
            content = hashlib.sha256(entry.read_bytes()).hexdigest()
        found[os.fspath(entry)] = f"{stat.S_IFMT(status.st_mode)} {content}"
    return found


def changed(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return the paths that two snapshots differ in."""
    paths = before.keys() | after.keys()
    return sorted(path for path in paths if before.get(path) != after.get(path))


def _walk(folder: Path, left_out: tuple[Path, ...]) -> Iterator[Path]:
    for entry in folder.iterdir():
        if entry in left_out:
            continue
        yield entry
        if entry.is_dir() and not entry.is_symlink():
            yield from _walk(entry, left_out)


def _regular_files(folder: Path) -> Iterator[Path]:
    """Yield the regular files below a folder that is not a link, however deep, without links."""
    waiting = [] if folder.is_symlink() else [os.fspath(folder)]
    while waiting:
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    yield Path(entry.path)
