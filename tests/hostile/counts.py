"""Numbers that no cell has: huge, negative, not finite, of another type."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from tests.hostile.looks import Look, Maker, all_looks, cells, report, rerun, status
from tests.hostile.reference import cell_of, edit, replace_column, seal

_SUMMARY = ("training_time_s", "gaussians", "memory_bytes", "peak_rss_bytes", "evaluations")
#: Values as JSON text; some have no form as a Python number that `json` writes back.
_JSON_NUMBERS = ("NaN", "Infinity", "1e308", "-1e308", "0", "1e-320", "1e400", "1" + "0" * 400)
_OTHER_TYPES = ('"x"', "[]", "{}", "null", "true", '"1e5"', '"\\u0000"')
_CSV_NUMBERS = ("Infinity", "-inf", "nan", "1e308", "1e400", "1_000", "0x10", "", "-0", "abc", "٣")


def _with_json(file: Path, keys: tuple[str, ...], value: str) -> None:
    """Write a value as JSON text under some keys of an object."""
    mark = "\0the value\0"
    edit(file, lambda d: d.update(dict.fromkeys(keys, mark)))
    file.write_text(file.read_text().replace(json.dumps(mark), value))


def _identity(key: str, value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    _with_json(cell / "identity.json", (key,), value)
    seal(cell)
    # The report of the sweep may be refused: its record contradicts the identity.
    return all_looks(store, done=None, planned=False, pair=False)


def _summary(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    _with_json(cell / "summary.json", (*_SUMMARY, "steps", "grow_grad2d"), value)
    seal(cell)
    return all_looks(store, done=None, planned=False)


def _totals(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    file, mark = cell / "summary.json", "\0the value\0"
    for key in ("work", "stage_seconds"):
        edit(file, lambda d, key=key: d.update({key: dict.fromkeys(d[key], mark)}))  # type: ignore[misc]
    file.write_text(file.read_text().replace(json.dumps(mark), value))
    seal(cell)
    return [report(store), status(store)]


def _work(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    _with_json(cell / "summary.json", ("work", "stage_seconds"), value)
    seal(cell)
    return [report(store), status(store)]


def _quality(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    replace_column(cell / "quality.csv", value, range(7))
    seal(cell)
    return [report(store, drawn=True), status(store)]


def _scores(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    replace_column(cell / "scores.csv", value, range(1, 9))
    seal(cell)
    return all_looks(store, done=None, planned=False)


def _history(value: str, columns: tuple[int, ...], store: Path) -> list[Look]:
    cell = cell_of(store)
    replace_column(cell / "history.csv", value, columns)
    seal(cell)
    return all_looks(store, done=None, planned=False, drawn=True)


def _text(name: str, content: bytes, store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / name).write_bytes(content)
    seal(cell)
    if name == "history.csv":  # only reports and reruns read it
        if len(content) > 1 << 22:
            return all_looks(store, name, done=3, drawn=True, planned=False)
        return all_looks(store, drawn=True, planned=False)
    named = () if content == _TEXTS["no rows"] else (name,)
    return [report(store, *named), cells(store, *named, done=None), status(store, done=None)]


def _config(keys: tuple[str, ...], value: Any, store: Path) -> list[Look]:
    cell = cell_of(store)

    def change(conf: Any) -> None:
        for key in keys[:-1]:
            conf = conf[key]
        conf[keys[-1]] = value

    edit(cell / "config.json", change)
    seal(cell)
    return [*all_looks(store, planned=False), rerun(cell)]


def _status_bytes(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    mark = "\0the value\0"
    edit(cell / "status.json", lambda d: d["files"]["scores.csv"].update(bytes=mark))
    file = cell / "status.json"
    file.write_text(file.read_text().replace(json.dumps(mark), value))
    return all_looks(store, done=3)


def _threads(value: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    _with_json(cell / "provenance.json", ("threads",), value)
    seal(cell)
    return [*all_looks(store, planned=False), rerun(cell)]


def _lock(fields: Mapping[str, object], store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    owner = {"host": socket.gethostname(), "boot": "b", "pid": 1, "started": 1} | dict(fields)
    (store / "locks" / f"{cell.name}.0").write_text(json.dumps(owner))
    return all_looks(store, done=3)


def _lock_name(name: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    (store / "locks" / f"{cell.name}.{name}").write_text("{}")
    return all_looks(store, done=3)


def _progress(values: str, store: Path) -> list[Look]:
    cell = cell_of(store)
    (cell / "status.json").unlink()
    (cell / "progress.json").write_text(f'{{"what":"a","unit":"step",{values}}}')
    owner = {"host": "elsewhere", "boot": "b", "pid": 1, "started": 1}
    (store / "locks" / f"{cell.name}.0").write_text(json.dumps(owner))
    return all_looks(store, done=3)


_HISTORIES = {
    f"history {value}": partial(_history, value, (2, 3, 4, 5, 6)) for value in _CSV_NUMBERS
}
_TEXTS = {
    "not UTF-8": b"\xff\xfe\0garbage\n" * 100,
    "an open quote": b'step,loss,gaussians,steps_HR\n"',
    "empty": b"",
    "no rows": b"step,view,loss,gaussians\n",
    "100,000 columns": b",".join(b"c%d" % n for n in range(100_000)) + b"\n",
    "a field of 10 MB": b"step,loss,gaussians\n1,2," + b"9" * 10_000_000 + b"\n",
}
_PROGRESS = ('"done":1e308,"total":-1e308,"rate":1e-308', '"done":NaN,"total":NaN,"rate":NaN')
CASES: Mapping[str, Maker] = {
    **{
        f"identity {key} {value:.10}": partial(_identity, key, value)
        for key, values in {
            "protocol": ("1e30", "1" + "0" * 30, *_JSON_NUMBERS, *_OTHER_TYPES),
            "seed": ("1e30", "1" + "0" * 400, str(2**63), "NaN", "-1", *_OTHER_TYPES),
            "variant": ('"../../.."', '"a\\u0000b"', "null", "5", f'"{"x" * 300}"', "[]"),
        }.items()
        for value in values
    },
    **{f"summary {v:.10}": partial(_summary, v) for v in (*_JSON_NUMBERS, *_OTHER_TYPES)},
    **{f"totals {v:.10}": partial(_totals, v) for v in (*_JSON_NUMBERS, *_OTHER_TYPES)},
    **{f"work {v:.10}": partial(_work, v) for v in _OTHER_TYPES},
    **{f"quality {value}": partial(_quality, value) for value in _CSV_NUMBERS},
    **{f"scores {value}": partial(_scores, value) for value in _CSV_NUMBERS},
    **_HISTORIES,
    "history steps 1e308": partial(_history, "1e308", (0,)),
    "history steps -1e308": partial(_history, "-1e308", (0, 2, 3)),
    **{
        f"{name} {what}": partial(_text, name, content)
        for name in ("history.csv", "scores.csv")
        for what, content in _TEXTS.items()
    },
    "config steps -1": partial(_config, ("train", "steps"), -1),
    "config steps 1e30": partial(_config, ("train", "steps"), 1e30),
    "config steps x": partial(_config, ("train", "steps"), "x"),
    "config seed 10**400": partial(_config, ("seed",), 10**400),
    "config train list": partial(_config, ("train",), []),
    "config plugins list": partial(_config, ("components", "plugins"), [[]]),
    **{
        f"status bytes {value:.10}": partial(_status_bytes, value)
        for value in ("-1", "1e30", "NaN", '"x"', "null")
    },
    **{f"threads {v:.10}": partial(_threads, v) for v in ("1" + "0" * 30, "-1", "1e999", '"x"')},
    "lock pid 10**30": partial(_lock, {"pid": 10**30}),
    "lock pid -1": partial(_lock, {"pid": -1, "started": -1}),
    "lock pid text": partial(_lock, {"pid": "../../self"}),
    "lock worker 10**400": partial(_lock, {"worker": 10**400}),
    "lock number of 26 digits": partial(_lock_name, "9" * 26),
    "lock number of 200 digits": partial(_lock_name, "9" * 200),
    "lock number superscript": partial(_lock_name, "²"),
    "lock number Arabic": partial(_lock_name, "٣"),
    **{f"progress {v}": partial(_progress, v) for v in _PROGRESS},
}
