"""Damaged files in one's own store: each command names the file and the field, without a traceback.

Every JSON file of the store is damaged in turn: cut off, of another type, and without a required
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

#: Files by their kind, and a field that must be there.
FILES = {
    "status.json": "state",
    "identity.json": "variant",
    "summary.json": "gaussians",
    "provenance.json": "xrgs",
    "config.json": "",
    "variant.json": "views",
    "sweep": "cells",
}
CASES = [(file, damage, "") for file in FILES for damage in ("cut", "type")]
CASES += [(file, "missing", field) for file, field in FILES.items() if field]
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
@pytest.mark.parametrize(("kind", "damage", "field"), CASES)
def test_a_damaged_file_is_named_by_every_command_and_raises_nothing(
    intact: Path,
    tmp_path: Path,
    call_command: Callable[..., tuple[int, str, str]],
    kind: str,
    damage: str,
    field: str,
) -> None:
    shutil.copytree(intact, tmp_path / "s")
    store = Store(tmp_path / "s")
    cell_id = store.sweep_record().cells[-1].cell_id
    assert cell_id is not None
    file = file_of(store, kind)
    damage_file(file, damage, field)
    said = {}
    for command in COMMANDS:
        # Any exception but the end of the command fails this test.
        _, out, message = call_command(*(cell_id if word == "CELL" else word for word in command))
        said[command[:2]] = out + message
    assert file.name in said["store", "check"]
    if kind in ("status.json", "sweep", "variant.json"):
        assert "damaged: " in said["store", "check"]
    if damage == "missing" and kind == "sweep":
        assert f"missing required field `{field}`" in said["store", "check"]
    if kind in ("status.json", "identity.json", "summary.json", "config.json"):
        state = store.cell(cell_id).state()
        assert state.name == "corrupt"
        assert kind in state.reason
        assert "corrupt" in said["store", "list"]
        assert kind in said["store", "show"]
        assert "corrupt" in said["report", "--store"]
        assert "1 corrupt" in said["status", "--store"]


@pytest.mark.parametrize(
    ("kind", "field"),
    [("identity.json", "variant"), ("summary.json", "gaussians"), ("provenance.json", "xrgs")],
)
def test_a_file_of_another_version_is_named(
    intact: Path,
    tmp_path: Path,
    call_command: Callable[..., tuple[int, str, str]],
    kind: str,
    field: str,
) -> None:
    """Its hash is right, so that only its decoder can refuse it."""
    shutil.copytree(intact, tmp_path / "s")
    store = Store(tmp_path / "s")
    cell_id = store.sweep_record().cells[-1].cell_id
    assert cell_id is not None
    cell = store.cell(cell_id)
    damage_file(file_of(store, kind), "missing", field)
    cell.finish(reference_store.TESTS, cell.status().scored_by)
    said = {}
    for command in COMMANDS:
        _, out, message = call_command(*(cell_id if word == "CELL" else word for word in command))
        said[command[:2]] = out + message
    what = f"{kind}: the file: Object missing required field `{field}`"
    for command in (("store", "check"), ("report", "--store")):
        assert f"damaged: {what}" in said[command]
