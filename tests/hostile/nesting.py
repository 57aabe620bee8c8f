"""Folders, names and JSON that are nested deeper or are longer than any of ours."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from tests.hostile.looks import Look, Maker, all_looks, inspect, rerun
from tests.hostile.reference import cell_of, edit, seal, sweep_file, variant_of

_DEEP = "[" * 100_000 + "]" * 100_000
_BRACES = '{"a":' * 20_000 + "1" + "}" * 20_000
_OURS = "[" * 60 + "]" * 60


def nest(folder: Path, levels: int, name: str = "d") -> None:
    """Make folders in one another, deeper than a path can name."""
    here = Path.cwd()
    try:
        os.chdir(folder)
        for _ in range(levels):
            Path(name).mkdir()
            os.chdir(name)
    finally:
        os.chdir(here)


def _folders(part: str, store: Path) -> list[Look]:
    (store / part).mkdir(parents=True, exist_ok=True)
    nest(store / part, 1500)
    return all_looks(store)


def _folders_beyond_paths(part: str, store: Path) -> list[Look]:
    """The path of the innermost folders is too long for any system call: ENAMETOOLONG."""
    nest(store / part, 30, "d" * 250)
    return all_looks(store)


def _in_a_cell(store: Path) -> list[Look]:
    nest(cell_of(store), 1500)
    return [*all_looks(store), rerun(cell_of(store), can_train=True)]


def _in_a_variant(store: Path) -> list[Look]:
    nest(variant_of(store), 1500)
    return [*all_looks(store), inspect(variant_of(store), shows=("view_1",))]


def _json(name: str, content: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / name).write_text(content)
    if name == "status.json":
        return all_looks(store, name, done=3)
    seal(cell)
    looks = all_looks(store, done=None, planned=False)
    return looks if name == "summary.json" else [*looks, rerun(cell, name)]


def _sweep(content: str, store: Path) -> list[Look]:
    file = sweep_file(store)
    file.write_text(content)
    return all_looks(store, pair=False, planned=False)


def _variant(content: str, store: Path) -> list[Look]:
    folder = variant_of(store)
    (folder / "variant.json").write_text(content)
    return [inspect(folder, "variant.json"), *all_looks(store, done=None)]


def _variant_report(content: str, store: Path) -> list[Look]:
    folder = variant_of(store)
    (folder / "report.json").write_text(content)
    return [inspect(folder, "report.json"), *all_looks(store, done=None, planned=False)]


def _file_names(name: str, store: Path) -> list[Look]:
    entry = {"bytes": 0, "sha256": ""}
    edit(cell_of(store) / "status.json", lambda d: d["files"].update({name: entry}))
    return all_looks(store, "status.json", done=3)


def _missing_name(name: str, store: Path) -> list[Look]:
    """A cell that lists a file of a name that no file system takes."""
    entry = {"bytes": 0, "sha256": ""}
    edit(cell_of(store) / "status.json", lambda d: d["files"].update({name: entry}))
    return all_looks(store, done=3)


_NOT_OBJECTS = {
    "nested": _DEEP,
    "of braces": _BRACES,
    "60 levels": _OURS,
    "empty": "",
    "zeros": "\0" * 1000,
    "truncated": '{"state":"done","files":{"a"',
    "a list": "[]",
    "null": "null",
    "a byte order mark": "\ufeff{}",
    "a name twice": '{"state":"done","state":"failed"}',
    "half a surrogate pair": '{"state":"\\ud800","scene":"\\ud800"}',
    "a number of 5,000 digits": f'{{"state":{"9" * 5000}}}',
}
_FILES = ("status.json", "identity.json", "config.json", "summary.json", "provenance.json")
#: Those of every file; all of them are read by one function.
_OF_EACH = frozenset({"nested", "a list", "half a surrogate pair", "a number of 5,000 digits"})
CASES: Mapping[str, Maker] = {
    **{
        f"1,500 folders in {p}": partial(_folders, p) for p in ("cells", ".", "variants", "reports")
    },
    "folders beyond any path in cells": partial(_folders_beyond_paths, "cells"),
    "folders beyond any path": partial(_folders_beyond_paths, "."),
    "1,500 folders in a cell": _in_a_cell,
    "1,500 folders in a variant": _in_a_variant,
    **{
        f"{name}: {what}": partial(_json, name, content)
        for name in _FILES
        for what, content in _NOT_OBJECTS.items()
        if name == "status.json" or what in _OF_EACH
    },
    **{f"sweep: {what}": partial(_sweep, content) for what, content in _NOT_OBJECTS.items()},
    **{f"variant.json: {what}": partial(_variant, text) for what, text in _NOT_OBJECTS.items()},
    **{f"report.json: {what}": partial(_variant_report, t) for what, t in _NOT_OBJECTS.items()},
    "a file's name of 2,000 parts": partial(_missing_name, "/".join(["a"] * 2000)),
    "a file's name of 3 MB": partial(_file_names, "x" * 3_000_000),
    "a file's name with a zero": partial(_file_names, "a\0b"),
}
