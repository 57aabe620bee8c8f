"""Records of sweeps whose rows contradict one another or the cells."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from tests.hostile.looks import Look, Maker, cells, report, status
from tests.hostile.reference import edit, sweep_file

Rows = list[dict[str, Any]]


def _rows(change: Callable[[Rows], Rows], store: Path) -> list[Look]:
    edit(sweep_file(store), lambda d: d.update(cells=change(d["cells"])))
    return [status(store), cells(store), report(store, pair=False, drawn=True)]


def _each(values: Mapping[str, object], rows: Rows) -> Rows:
    return [row | dict(values) for row in rows]


def _ablations(values: Mapping[str, object], rows: Rows) -> Rows:
    return [row if row["label"] == "baseline" else row | dict(values) for row in rows]


def _without(key: str, rows: Rows) -> Rows:
    return [{name: value for name, value in row.items() if name != key} for row in rows]


def _self_baseline(rows: Rows) -> Rows:
    return [row | {"baseline_id": row["cell_id"]} for row in rows]


def _crossed(rows: Rows) -> Rows:
    return [row | {"baseline_id": rows[-1]["cell_id"]} for row in rows]


def _many_labels(rows: Rows) -> Rows:
    return [row | {"label": f"l{number}" * 20} for number in range(1250) for row in rows]


def _many_scenes(rows: Rows) -> Rows:
    return [row | {"scene": f"scene {number}"} for number in range(2500) for row in rows]


def _whole(content: str, store: Path) -> list[Look]:
    sweep_file(store).write_text(content)
    name = "" if '"cells": []' in content else sweep_file(store).name
    return [status(store), cells(store), report(store, name, pair=False)]


def _another(content: bytes, store: Path) -> list[Look]:
    """A second record, later than the healthy one, which the report takes by default."""
    (store / "sweeps" / "zz.json").write_bytes(content)
    return [status(store), cells(store), report(store, "zz.json", pair=False)]


def _same_time(store: Path) -> list[Look]:
    """1,000 records of other sweeps."""
    text = sweep_file(store).read_text()
    for number in range(1000):
        (store / "sweeps" / f"{number:016x}.json").write_text(text)
    return [status(store), cells(store), report(store)]


_TYPES: Mapping[str, object] = {
    "null": None,
    "a list": [[]],
    "an object": {"a": 1},
    "a number": 1e308,
    "a path": "../../OUTSIDE",
    "a zero": "a\0b",
    "half a surrogate pair": "\ud800",
}
_WHOLE = {
    "version 1e999": '{"version":1e999}',
    "cells of numbers": '{"version":1,"command":[],"cells":[1]}',
    "no cells": '{"version":1,"command":[],"cells": []}',
    "seed NaN": '{"version":1,"command":[],"cells":[{"seed":NaN}]}',
    "cells of nothing": '{"version":1,"command":[],"cells":[{}]}',
    "a command of 100,000 words": json.dumps(
        {"version": 1, "command": ["a"] * 100_000, "cells": []}
    ),
}
_ROWS: Mapping[str, Callable[[Rows], Rows]] = {
    "every row three times": lambda rows: rows * 3,
    "all baselines": partial(_each, {"label": "baseline"}),
    "no baselines": partial(_each, {"label": "x"}),
    "its own baseline": _self_baseline,
    "one baseline for all": _crossed,
    "cells that are not there": partial(_each, {"cell_id": "nothing"}),
    "no ids": partial(_each, {"cell_id": None, "baseline_id": None, "variant_id": None}),
    "an error of a done cell": partial(_each, {"error": "x" * 100_000}),
    "empty names": partial(_each, {"scene": "", "label": "", "condition": ""}),
    "another seed": partial(_each, {"seed": 2**62}),
    "5,000 rows of other labels": _many_labels,
    "10,000 rows of other scenes": _many_scenes,
    "labels of 300 characters": partial(_ablations, {"label": "x" * 300}),
    "labels of dots": partial(_ablations, {"label": "../../../OUTSIDE/x"}),
    **{
        f"{key} {what}": partial(_each, {key: value})
        for key in ("cell_id", "label", "seed", "variant_id", "baseline_id", "error")
        for what, value in _TYPES.items()
    },
    **{
        f"no {key}": partial(_without, key)
        for key in ("cell_id", "label", "condition", "scene", "seed", "error", "baseline_id")
    },
}
CASES: Mapping[str, Maker] = {
    **{what: partial(_rows, change) for what, change in _ROWS.items()},
    **{what: partial(_whole, content) for what, content in _WHOLE.items()},
    "another that is not UTF-8": partial(_another, b"\xff\xfe\x00{}"),
    "another that is empty": partial(_another, b""),
    "another of version 2": partial(_another, b'{"version":2}'),
    "1,000 others": _same_time,
}
