"""The rules of the package's structure: which package may import what.

A package is a folder of `xrgs/`, or a file at its top. Imports for types alone count as well.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import xrgs

PACKAGE = Path(xrgs.__file__).parent
FILES = {
    path.relative_to(PACKAGE).with_suffix("").as_posix(): path for path in PACKAGE.rglob("*.py")
}
#: The packages in the order that data passes through them: an import never points to a later one.
FLOW = (
    "errors",
    "safeio",
    "runtime",
    "splat",
    "config",
    "composing",
    "registry",
    "plugins",
    "formats",
    "photos",
    "mixture",
    "training",
    "evaluation",
    "store",
    "viewer",
    "report",
    "sweep",
    "bench",
    "cli",
)
LAYER = {name: number for number, name in enumerate(FLOW)}
#: Libraries that only these packages or modules may import.
ONLY_IN = {
    "hydra": ("composing", "sweep", "cli"),
    "omegaconf": ("composing", "sweep", "cli"),
    "pycolmap": ("mixture/colmap", "photos/lens", "mixture/sfm"),
    "matplotlib": ("report", "bench"),
    "pandas": ("store", "report", "bench"),
    "kornia": ("evaluation/metrics/ssim",),
    "gsplat": ("splat/gsplat/rasterizer",),
    "tqdm": ("runtime/progress", "sweep/monitor"),
    "av": ("photos/scenes/video", "viewer/film"),
    "imagecodecs": ("photos/colour", "photos/tiff"),
    "tifffile": ("photos/tiff",),
    "viser": ("viewer/live",),
    "zstandard": ("formats/spz",),
    "tensorboard": ("sweep/track",),
    "mlflow": ("sweep/track",),
    "wandb": ("sweep/track",),
}
#: Modules that must load without torch, pycolmap, kornia and scikit-image: planning, reporting.
LIGHT = (
    "mixture.variant",
    "cli.data",
    "cli.render",
    "cli.report",
    "cli.status",
    "cli.store",
    "cli.sweep",
    "cli.train",
    "cli.view",
    "report",
    "sweep.build_variants",
    "sweep.cleaning",
    "sweep.job",
    "sweep.monitor",
    "sweep.rerun",
    "sweep.status",
    "sweep.study",
)


def package_of(name: str) -> str:
    return name.partition("/")[0]


def module_of(imported: str) -> str:
    """The file that an imported dotted name is in; `__init__` where it is the package itself."""
    parts = imported.split(".")[1:]
    while parts:
        for file in ("/".join(parts), "/".join([*parts, "__init__"])):
            if file in FILES:
                return file
        parts.pop()
    return "__init__"


@cache
def imports(path: Path) -> set[str]:
    """Every dotted name that a file imports, at its top, inside a function or for types alone."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def own_imports(name: str) -> set[str]:
    """The files of this package that a file imports, its compiled module aside."""
    ours = {module for module in imports(FILES[name]) if module.split(".")[0] == "xrgs"}
    return {module_of(module) for module in ours if module != "xrgs._native"} - {name}


def test_every_module_lies_in_a_package() -> None:
    assert {package_of(name) for name in FILES} - {"__init__"} == set(FLOW)


def test_imports_point_down_the_flow() -> None:
    wrong = [
        f"{name} -> {other}"
        for name in FILES
        if name != "__init__"
        for other in own_imports(name) - {"__init__"}
        if LAYER[package_of(other)] > LAYER[package_of(name)]
    ]
    assert not wrong


def test_there_is_no_circle() -> None:
    left = {name: own_imports(name) for name in FILES}
    # A package's `__init__` may gather what its modules define; these never import it back.
    while free := [name for name, others in left.items() if not others & left.keys()]:
        for name in free:
            del left[name]
    assert not left


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_is_imported_in_its_packages_alone(library: str) -> None:
    users = {
        name
        for name, path in FILES.items()
        if any(module.split(".")[0] == library for module in imports(path))
    }
    allowed = ONLY_IN[library]
    assert {n for n in users if n not in allowed and package_of(n) not in allowed} == set()


def test_the_model_knows_nothing_of_experiments() -> None:
    used = {
        package_of(other)
        for name in FILES
        if package_of(name) == "splat"
        for other in own_imports(name)
    }
    # The top of the package is imported anyway, and imports nothing itself.
    assert used <= {"__init__", "errors", "safeio", "splat"}


def test_reports_have_no_torch_code() -> None:
    """What needs torch for a report is in packages before it, and is called where it is needed."""
    reports = {name: imports(path) for name, path in FILES.items() if package_of(name) == "report"}
    found = {name for name, of in reports.items() if any(m.split(".")[0] == "torch" for m in of)}
    assert not found


@pytest.mark.slow
def test_planning_and_reporting_run_without_torch() -> None:
    # One process for all: each further module is checked right after its import.
    script = (
        "import importlib, sys, xrgs.composing, xrgs.store.identity\n"
        f"for module in {LIGHT!r}:\n"
        "    importlib.import_module(f'xrgs.{module}')\n"
        "    heavy = {'torch', 'pycolmap', 'kornia', 'skimage'} & set(sys.modules)\n"
        "    assert not heavy, (module, heavy)\n"
        "conf = xrgs.composing.compose('splat.backend=native', '+ablation=plus')\n"
        "xrgs.store.identity.cell_identity(conf, 'v')\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-P", "-c", script], check=True)
