"""The house's own rules: which room may import what.

A room is a folder or a file of `xrgs/`. Where a folder's files have an order of their own, each of
them is one: `variant/sfm`; its face, which other rooms import, is `variant/__init__`.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import xrgs

PACKAGE = Path(xrgs.__file__).parent
FILES = {
    path.relative_to(PACKAGE).with_suffix("").as_posix(): path for path in PACKAGE.rglob("*.py")
}
#: Libraries that only these rooms may import.
ONLY_IN = {
    "hydra": ("arguments", "config", "study", "cli"),
    "omegaconf": ("arguments", "config", "study", "cli"),
    "pycolmap": ("variant/sfm",),
    "matplotlib": ("report",),
    "pandas": ("store", "report"),
    "gsplat": (),
    "tqdm": ("progress", "study"),
}
#: Rooms in the order that data walks through them: an import never points to a later one.
FLOW = (
    ("errors", "files", "foreign", "hashing", "machine", "npz", "splat", "stop", "streams"),
    ("checkpoint", "progress", "records", "weights"),
    ("images", "variant/alignment", "variant/split", "variant/views", "variant/degrade"),
    ("arguments", "config", "scenes", "variant/sfm"),
    ("variant/photographs", "variant/tagging"),
    ("variant/placing",),
    ("variant/mixing",),
    ("variant/frozen",),
    ("variant/__init__",),
    ("dataset", "lpips", "metrics", "components"),
    ("train", "evaluate"),
    ("identity", "provenance"),
    ("store",),
    ("cell",),
    ("jobs",),
    ("report",),
    ("data",),
    ("bench",),
    ("study",),
    ("cli",),
)
FLOOR = {name: number for number, rooms in enumerate(FLOW) for name in rooms}
PLANNING = ("study.live", "study.rerun", "study.status", "study.sweep")


def room(file: str) -> str:
    return file if file in FLOOR else file.partition("/")[0]


def file_of(imported: str) -> str:
    """The file of ours that an imported name is in; the name of none of ours is in `__init__`."""
    parts = imported.split(".")[1:] if imported.startswith("xrgs.") else []
    while parts:
        file = "/".join(parts)
        if file in FILES:
            return file
        if f"{file}/__init__" in FILES:
            return f"{file}/__init__"
        parts.pop()
    return "__init__"


def imports(path: Path) -> set[str]:
    """What a file imports, at its top or inside a function; not for types alone."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_is_imported_in_its_rooms_alone(library: str) -> None:
    users = {
        name
        for name, path in FILES.items()
        if any(module.split(".")[0] == library for module in imports(path))
    }
    assert {room(name) for name in users} <= set(ONLY_IN[library])


def test_imports_point_down_the_flow() -> None:
    wrong = []
    for name, path in FILES.items():
        if name in {"__init__", "__main__"}:
            continue
        for module in imports(path):
            target = room(file_of(module))
            if target in FLOOR and FLOOR[target] > FLOOR[room(name)]:
                wrong.append(f"{name} -> {module}")
    assert not wrong


def test_who_wants_a_variant_asks_at_its_face() -> None:
    for name, path in FILES.items():
        asked = {file_of(module) for module in imports(path)} - {"variant/__init__"}
        assert name.startswith("variant/") or not {f for f in asked if f.startswith("variant/")}


def test_every_room_is_on_the_plan() -> None:
    rooms = {room(name) for name in FILES} - {"__init__"}
    assert rooms <= FLOOR.keys()


def test_the_model_knows_nothing_of_experiments() -> None:
    allowed = {"errors", "splat"}
    for name, path in FILES.items():
        if room(name) == "splat":
            used = {m.split(".")[1] for m in imports(path) if m.startswith("xrgs.")}
            assert used <= allowed | {"_native"}, name


@pytest.mark.parametrize("name", ["cli", "jobs.job", "report", "variant", *PLANNING])
def test_planning_and_reporting_run_without_torch(name: str) -> None:
    heavy = {"torch", "pycolmap", "kornia", "skimage"}
    script = f"import sys, xrgs.{name}; print(sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
