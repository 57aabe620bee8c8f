"""Words in a store that a terminal, a spreadsheet, a page or LaTeX would obey."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from tests.hostile.looks import Look, Maker, all_looks, cells, inspect, plan, report, rerun, status
from tests.hostile.reference import (
    all_cells,
    cell_of,
    edit,
    replace_column,
    seal,
    seal_variant,
    sweep_file,
    variant_of,
)

ESCAPES = "x\x1b]0;owned\x07\x1b[2J\x9b31m\u202eabc\r\n# heading"
_EVIL = (
    "=HYPERLINK('http://127.0.0.1')<script>alert(1)</script>"
    + ESCAPES
    + " | a | [x](javascript:alert(1)) ![i](http://127.0.0.1/x.png) \\input{/etc/passwd}"
    "\\write18{touch CANARY} $\\frac{$ ${oc.env:HOME} @{u}"
)


def evil(store: Path) -> str:
    """A text for every reader at once; it would make the file `canary` beside the store."""
    return _EVIL.replace("CANARY", str(store.with_name("canary")))


def _labels(store: Path) -> list[Look]:
    def change(record: dict[str, list[dict[str, object]]]) -> None:
        for row in record["cells"]:
            row["scene"] = row["condition"] = evil(store)
            if row["label"] != "baseline":
                row["label"] = f"=cmd|calc!A1{evil(store)}"
        record["command"] = [evil(store)]  # type: ignore[list-item]

    edit(sweep_file(store), change)
    return [status(store), report(store, pair=False, drawn=True), cells(store), plan(store)]


def _formulas(begins: str, store: Path) -> list[Look]:
    def change(record: dict[str, list[dict[str, str]]]) -> None:
        for row in record["cells"]:
            row["scene"] = f"{begins}1+1"
            if row["label"] != "baseline":
                row["label"] = f"{begins}2"

    edit(sweep_file(store), change)
    return [status(store), report(store, pair=False)]


def _mathtext(store: Path) -> list[Look]:
    def change(record: dict[str, list[dict[str, str]]]) -> None:
        for row in record["cells"]:
            row["scene"] = r"$\frac{1}{$ \undefined $x^"
            if row["label"] != "baseline":
                row["label"] = r"$\begin{a}$ $\notacommand$"

    edit(sweep_file(store), change)
    return [status(store), report(store, pair=False, drawn=True)]


def _folder_name(name: str | bytes, part: str, store: Path) -> list[Look]:
    os.mkdir(os.path.join(os.fsencode(store / part), os.fsencode(name)))  # noqa: PTH102, PTH118
    return all_looks(store)


def _file_name(name: str | bytes, part: str, store: Path) -> list[Look]:
    path = os.path.join(os.fsencode(store / part), os.fsencode(name))  # noqa: PTH118
    with open(path, "w", encoding="utf-8") as file:  # noqa: PTH123
        file.write("{}")
    return [status(store), cells(store), plan(store), report(store, pair=False)]


def _store_name(name: str, store: Path) -> list[Look]:
    renamed = store / name  # below the store's folder, which is the only one that is written to
    renamed.mkdir()
    for part in ("cells", "locks", "scenes", "sweeps", "variants"):
        (store / part).rename(renamed / part)
    return [
        status(renamed),
        report(renamed),
        cells(renamed),
        status(renamed / "missing", done=None),
    ]


def _code_keys(store: Path) -> list[Look]:
    for cell in all_cells(store):
        edit(cell / "identity.json", lambda d: d["code"].update({f"{ESCAPES}.py": "0"}))
        seal(cell)
    return [*all_looks(store), rerun(cell_of(store), can_train=True)]


def _reason(store: Path) -> list[Look]:
    failed = {"state": "failed", "reason": ESCAPES, "views": [], "files": {}}
    (cell_of(store) / "status.json").write_text(json.dumps(failed))
    return [*all_looks(store, done=3), rerun(cell_of(store))]


def _state(store: Path) -> list[Look]:
    unknown = {"state": f"do{ESCAPES}", "reason": "", "views": [], "files": {}}
    (cell_of(store) / "status.json").write_text(json.dumps(unknown))
    looks = all_looks(store, "status.json", done=3)
    return [*looks, rerun(cell_of(store), can_train=True)]


def _status_file_names(store: Path) -> list[Look]:
    edit(cell_of(store) / "status.json", lambda d: d["files"].update({ESCAPES: {"bytes": 0}}))
    return all_looks(store, "status.json", done=3)


def _not_json(store: Path) -> list[Look]:
    (cell_of(store) / "status.json").write_text('{"a":1 \x1b]0;owned\x07')
    return [*all_looks(store, "status.json", done=3), rerun(cell_of(store), can_train=True)]


def _rerun_values(store: Path) -> list[Look]:
    cell = cell_of(store)
    edit(cell / "summary.json", lambda d: d.update(steps=ESCAPES, gaussians=ESCAPES))
    edit(cell / "identity.json", lambda d: d.update({ESCAPES: 1, "arithmetic": ESCAPES}))
    edit(cell / "identity.json", lambda d: d.update(protocol=ESCAPES))
    edit(cell / "provenance.json", lambda d: d.update({ESCAPES: ESCAPES}))
    seal(cell)
    return [rerun(cell, can_train=True)]


def _rerun_variant(store: Path) -> list[Look]:
    cell = cell_of(store)
    edit(cell / "identity.json", lambda d: d.update(variant=ESCAPES))
    seal(cell)
    looks = [status(store, done=None), cells(store, done=None), plan(store)]
    return [*looks, report(store, "identity.json", pair=False), rerun(cell, "identity.json")]


def _rerun_config(store: Path) -> list[Look]:
    cell = cell_of(store)
    edit(cell / "config.json", lambda d: d.update({ESCAPES: 1}))
    seal(cell)
    return [*all_looks(store), rerun(cell, "config.json")]


def _plugins(store: Path) -> list[Look]:
    cell = cell_of(store)
    edit(cell / "config.json", lambda d: d["components"].update(plugins={ESCAPES: {}, "os": {}}))
    seal(cell)
    return [*all_looks(store), rerun(cell)]


def _provenance(store: Path) -> list[Look]:
    for cell in all_cells(store):
        edit(cell / "provenance.json", lambda d: d.update(cpu=evil(store), git=evil(store)))
        edit(cell / "provenance.json", lambda d: d.update({f"={ESCAPES}": evil(store)}))
        seal(cell)
    return all_looks(store)


def _failed_scene(store: Path) -> list[Look]:
    folder = store / "variants" / "failed-0123456789abcdef"
    folder.mkdir()
    attempts = [{"attempt": ESCAPES, "refused": ESCAPES}]
    report_ = {"scene": ESCAPES, "reason": ESCAPES, "attempts": attempts, "tags": ESCAPES}
    (folder / "report.json").write_text(json.dumps(report_))
    return [*all_looks(store), inspect(folder)]


def _inspected(store: Path) -> list[Look]:
    folder = variant_of(store)
    edit(folder / "variant.json", lambda d: d.update(scene=evil(store)))
    values = {"tags": ESCAPES, "not_registered": [ESCAPES], "lr": [ESCAPES], "images": ESCAPES}
    edit(folder / "report.json", lambda d: d.update(values, attempts=[{"attempt": ESCAPES}]))
    return _looks_at_damaged_variant(store, folder)


def _inspected_view(store: Path) -> list[Look]:
    folder = variant_of(store)
    edit(folder / "variant.json", lambda d: d["views"][0].update(name="\u202e\u2066=1+1|x"))
    sealed = seal_variant(folder)
    return [inspect(sealed), report(store, drawn=True)]


def _scene_of_lines(store: Path) -> list[Look]:
    folder = variant_of(store)
    edit(folder / "variant.json", lambda d: d.update(scene="one\ntwo\nthree\n"))
    return _looks_at_damaged_variant(store, folder)


def _looks_at_damaged_variant(store: Path, folder: Path) -> list[Look]:
    """A name that is not one line of text is refused, and no plan goes on with the variant."""
    others = [status(store), report(store), cells(store), plan(store, done=None)]
    return [*others, inspect(folder, "variant.json")]


def _score_views(store: Path) -> list[Look]:
    for cell in all_cells(store):
        text = (cell / "scores.csv").read_text()
        (cell / "scores.csv").write_text(text.replace("view_1", "=1+cmd|<b>\\input{x}\u202e"))
        edit(
            cell / "status.json", lambda d: d.update(views=["=1+cmd|<b>\\input{x}\u202e", "view_2"])
        )
        seal(cell)
    return all_looks(store, drawn=True, pair=False, done=None)


def _history_columns(store: Path) -> list[Look]:
    for cell in all_cells(store):
        text = (cell / "history.csv").read_text()
        header = text.replace("split", '"=a.\x1b]0;owned\x07|<script>\u202e"', 1)
        (cell / "history.csv").write_text(header)
        seal(cell)
    return all_looks(store, drawn=True)


def _history_views(store: Path) -> list[Look]:
    for cell in all_cells(store):
        replace_column(cell / "history.csv", "\x1b]0;owned\x07=1", [1])
        seal(cell)
    return all_looks(store, drawn=True)


def _lock_owner(store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    owner = {"host": ESCAPES, "boot": "b", "pid": 1, "started": 1}
    (store / "locks" / f"{cell.name}.0").write_text(json.dumps(owner))
    return all_looks(store, done=3)


def _progress(store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    done = {"what": ESCAPES, "unit": ESCAPES, "done": 1, "total": 2, "rate": 1.0}
    (cell / "progress.json").write_text(json.dumps(done))
    owner = {"host": socket.gethostname(), "boot": "b", "pid": 1, "started": 1}
    (store / "locks" / f"{cell.name}.0").write_text(json.dumps(owner))
    return all_looks(store, done=3)


def _interpolations(store: Path) -> list[Look]:
    target, values = cell_of(store), cell_of(store, "consistency", 0)
    edit(target / "config.json", lambda d: d.update(_target_="os.system", store="${oc.env:HOME}"))
    seal(target)
    edit(values / "config.json", lambda d: d["scene"].update(path="${oc.env:HOME}/x"))
    edit(values / "config.json", lambda d: d.update(store="${hydra:runtime.cwd}"))
    seal(values)
    return [*all_looks(store), rerun(target, "config.json"), rerun(values, can_train=True)]


def _label_of_a_megabyte(store: Path) -> list[Look]:
    def change(record: dict[str, list[dict[str, str]]]) -> None:
        for row in record["cells"]:
            if row["label"] != "baseline":
                row["label"] = "x" * 1_000_000

    edit(sweep_file(store), change)
    return [status(store), report(store, pair=False, drawn=True), cells(store), plan(store)]


def _reason_of_a_megabyte(store: Path) -> list[Look]:
    failed = {"state": "failed", "reason": "x " * 500_000, "views": [], "files": {}}
    (cell_of(store) / "status.json").write_text(json.dumps(failed))
    return [*all_looks(store, done=3), rerun(cell_of(store))]


CASES: Mapping[str, Maker] = {
    "labels of everything": _labels,
    **{f"labels that begin with {begins!r}": partial(_formulas, begins) for begins in "=+-@\t\r"},
    "labels of mathtext": _mathtext,
    "a folder of escapes": partial(_folder_name, "a\x1b[31m\x1b]0;owned\x07\u202e", "."),
    "a cell of escapes": partial(_folder_name, "a\x1b[31m\u202e", "cells"),
    "a variant of escapes": partial(_folder_name, "a\x1b[31m-\u202e", "variants"),
    "a failed scene of escapes": partial(_folder_name, "failed-\x1b[31m\u202e", "variants"),
    "a sweep of escapes": partial(_file_name, "a\x1b[31m\u202e.json", "sweeps"),
    "a lock of escapes": partial(_file_name, "a\x1b[31m\u202e.0", "locks"),
    "a folder not in UTF-8": partial(_folder_name, b"a\xff\xfe", "."),
    "a cell not in UTF-8": partial(_folder_name, b"a\xff\xfe", "cells"),
    "a variant not in UTF-8": partial(_folder_name, b"a\xff-\xfe", "variants"),
    "a sweep not in UTF-8": partial(_file_name, b"a\xff\xfe.json", "sweeps"),
    "a lock not in UTF-8": partial(_file_name, b"a\xff\xfe.0", "locks"),
    "a store named by escapes": partial(_store_name, "a\x1b[31m\x1b]0;owned\x07\u202e\nb"),
    "a store named by markup": partial(_store_name, "=1+1 <b>${oc.env:HOME}{x}"),
    "names of source files": _code_keys,
    "reason of a failure": _reason,
    "unknown state": _state,
    "names of a cell's files": _status_file_names,
    "a status that is not JSON": _not_json,
    "values that rerun compares": _rerun_values,
    "a variant's id of escapes": _rerun_variant,
    "a key of the config": _rerun_config,
    "names of plugins": _plugins,
    "provenance": _provenance,
    "report of a failed scene": _failed_scene,
    "report of a variant": _inspected,
    "names of a variant's views": _inspected_view,
    "a scene of several lines": _scene_of_lines,
    "names of scored views": _score_views,
    "columns of the history": _history_columns,
    "views of the history": _history_views,
    "owner of a lock": _lock_owner,
    "progress of a cell": _progress,
    "interpolations in the config": _interpolations,
    "a label of 1 MB": _label_of_a_megabyte,
    "a reason of 1 MB": _reason_of_a_megabyte,
}
