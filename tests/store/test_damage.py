"""Damaged files in one's own store: each command names the file and the field, without a traceback.

Every JSON file of the store is damaged in turn: cut off, of another type, or without a required
field.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import reference_store
from xrgs.store.store import Store

#: A kind of files, how one is damaged, the field that is then missing, and whether the cell lists
#: the hash of the damaged file, which only its decoder can refuse: as a file of another version.
CASES = [
    ("status.json", "missing", "state", False),
    ("identity.json", "type", "", False),
    ("summary.json", "cut", "", False),
    ("summary.json", "missing", "gaussians", True),
    ("provenance.json", "missing", "xrgs", True),
    ("config.json", "type", "", False),
    ("variant.json", "missing", "views", False),
    ("sweep", "missing", "cells", False),
]
COMMANDS: tuple[tuple[str, ...], ...] = (
    ("status", "--store", "s"),
    ("store", "list", "--store", "s"),
    ("store", "show", "CELL", "--store", "s"),
    ("store", "check", "--store", "s"),
    ("report", "list", "--store", "s"),
    ("report", "--store", "s", "--pictures", "none"),
)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("intact") / "s"
    reference_store.build(folder)
    return folder


def file_of(store: Store, kind: str) -> Path:
    """The file of a kind, of the cell of the second ablation and seed where it is of a cell."""
    (record,) = store.sweeps.iterdir()
    if kind == "sweep":
        return record
    if kind == "variant.json":
        return next(store.variants.iterdir()) / kind
    cell_id = store.sweep_record().cells[-1].cell_id
    assert cell_id is not None
    return store.cell(cell_id).path / kind


def damage_file(file: Path, damage: str, field: str) -> None:
    text = file.read_text()
    if damage == "cut":
        file.write_text(text[: len(text) // 2])
    elif damage == "type":
        file.write_text("[3]")
    else:
        content: dict[str, Any] = json.loads(text)
        del content[field]
        file.write_text(json.dumps(content))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "damage", "field", "listed"), CASES)
def test_a_damaged_file_is_named_by_every_command_and_raises_nothing(
    intact: Path,
    tmp_path: Path,
    call_command: Callable[..., tuple[int, str, str]],
    kind: str,
    damage: str,
    field: str,
    listed: bool,
) -> None:
    shutil.copytree(intact, tmp_path / "s")
    store = Store(tmp_path / "s")
    cell_id = store.sweep_record().cells[-1].cell_id
    assert cell_id is not None
    file, cell = file_of(store, kind), store.cell(cell_id)
    damage_file(file, damage, field)
    if listed:
        cell.finish(reference_store.TESTS, cell.status().scored_by)
    said = {}
    for command in COMMANDS:
        # Any exception but the end of the command fails this test.
        _, out, message = call_command(*(cell_id if word == "CELL" else word for word in command))
        said[command[:2]] = out + message
    assert file.name in said["store", "check"]
    if kind in ("status.json", "sweep", "variant.json"):
        assert "damaged: " in said["store", "check"]
    if kind == "sweep":
        assert f"missing required field `{field}`" in said["store", "check"]
    if listed:
        what = f"damaged: {kind}: the file: Object missing required field `{field}`"
        assert what in said["store", "check"]
        assert what in said["report", "--store"]
    elif kind in ("status.json", "identity.json", "summary.json", "config.json"):
        state = cell.state()
        assert state.name == "corrupt"
        assert kind in state.reason
        assert "corrupt" in said["store", "list"]
        assert kind in said["store", "show"]
        assert "corrupt" in said["report", "--store"]
        assert "1 corrupt" in said["status", "--store"]
