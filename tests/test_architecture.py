"""The house's own rules: which room may import what."""

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
#: Libraries that only these rooms may import (a folder stands for its files).
ONLY_IN = {
    "hydra": ("arguments", "config", "study", "cli"),
    "omegaconf": ("arguments", "config", "study", "cli"),
    "pycolmap": ("sfm",),
    "matplotlib": ("report",),
    "pandas": ("store", "report"),
    "gsplat": (),
    "tqdm": ("progress", "study"),
}
#: Rooms in the order that data walks through them: an import never points to a later one.
FLOW = (
    ("errors", "files", "foreign", "hashing", "machine", "npz", "splat", "stop", "streams"),
    ("checkpoint", "progress", "records", "weights"),
    ("images", "alignment", "split", "views", "degrade"),
    ("arguments", "config", "scenes", "sfm"),
    ("photographs", "tagging"),
    ("placing",),
    ("mixing",),
    ("variant",),
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
PLANNING = ("study.live", "study.rerun", "study.status", "study.sweep")


def room(module: str) -> str:
    return module.partition("/")[0]


def imports(path: Path) -> set[str]:
    """Modules that a file imports, at its top or inside a function; not those for types alone."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
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
    floor = {name: number for number, rooms in enumerate(FLOW) for name in rooms}
    wrong = []
    for name, path in FILES.items():
        if name in {"__init__", "__main__"}:
            continue
        for module in imports(path):
            parts = module.split(".")
            target = parts[1] if parts[0] == "xrgs" and len(parts) > 1 else None
            if target in floor and floor[target] > floor[room(name)]:
                wrong.append(f"{name} -> {module}")
    assert not wrong


def test_every_room_is_on_the_plan() -> None:
    rooms = {room(name) for name in FILES} - {"__init__"}
    assert rooms <= {name for names in FLOW for name in names}


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
