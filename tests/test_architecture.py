"""The rules of the package's structure: which package may import what.

A package is a folder of `xrgs/`, or a file at its top. Imports for types alone count as well.
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
#: The packages in the order that data passes through them: an import never points to a later one.
FLOW = (
    "errors",
    "safeio",
    "runtime",
    "splat",
    "config",
    "composing",
    "capture",
    "training",
    "evaluation",
    "experiment",
    "viewer",
    "report",
    "sweep",
    "bench",
    "cli",
)
LAYER = {name: number for number, name in enumerate(FLOW)}
#: Libraries that only these packages or modules may import.
ONLY_IN = {
    "aiohttp": ("capture/download/exchange",),
    "hydra": ("config", "composing", "sweep", "cli"),
    "omegaconf": ("config", "composing", "sweep", "cli"),
    "pycolmap": ("capture/colmap", "capture/sfm"),
    "matplotlib": ("report", "bench"),
    "pandas": ("experiment", "report", "bench"),
    "kornia": ("evaluation/metrics",),
    "gsplat": (),
    "tqdm": ("runtime/progress", "sweep/monitor"),
    "av": ("capture/scenes/video", "viewer/film"),
    "viser": ("viewer/live",),
    "tensorboard": ("sweep/track",),
    "mlflow": ("sweep/track",),
}
#: Modules that must load without torch, pycolmap, kornia, scikit-image and aiohttp: planning and
#: reporting.
LIGHT = (
    "capture.variant",
    "cli.data",
    "cli.render",
    "cli.report",
    "cli.status",
    "cli.store",
    "cli.sweep",
    "cli.view",
    "report",
    "sweep.cleaning",
    "sweep.inventory",
    "sweep.jobs.job",
    "sweep.monitor",
    "sweep.rerun",
    "sweep.session",
    "sweep.show",
    "sweep.status",
    "sweep.study",
    "sweep.variants",
)


#: Functions that reach the disk, or decode what somebody else may have written, by their names or
#: the beginning of these, and the modules outside `safeio` that may call them all the same. The
#: methods of `pathlib.Path` are checked by tests/typing/file_access.py, a plugin of mypy.
FILE_FUNCTIONS: dict[str, dict[str, str]] = {
    "open": {},
    **{
        f"os.{name}": {}
        for name in (
            *("chmod", "fdopen", "listdir", "lstat", "makedirs", "mkdir", "mkfifo"),
            *("open", "readlink", "remove", "removedirs", "rename", "renames", "replace", "rmdir"),
            *("scandir", "stat", "symlink", "truncate", "unlink", "utime", "walk"),
        )
    },
    "os.access": {"bench/against": "the executable that the user names"},
    "os.link": {},
    "os.path.": {},
    "shutil.": {},
    "shutil.copyfileobj": {
        "capture/download/unpack": "from stream to stream",
        "experiment/attempts": "from stream to stream",
        "experiment/export": "from stream to stream",
    },
    "tempfile.": {
        "bench/against": "a folder of its own in /tmp",
        "capture/sfm": "a folder in /tmp for COLMAP, whose database takes a plain path",
        "evaluation/lpips/download": "a folder of its own in /tmp",
        "experiment/store": "a nameless file, to see whether the disk has room",
        "sweep/jobs/worker": "a folder of its own in /tmp",
    },
    "glob.": {},
    "io.open": {},
    "json.load": {},
    "json.loads": {
        "bench/against": "the answers of its own process",
        "bench/against_worker": "the requests of the process that started it",
        "bench/training": "the answer of its own process",
    },
    "csv.reader": {},
    "csv.DictReader": {},
    "configparser.": {},
    "sqlite3.": {},
    "pickle.": {"evaluation/lpips/weights": "admits three constructors of numpy alone"},
    "zipfile.": {
        "capture/download/unpack": "the archive that was downloaded",
        "training/checkpoint": "writes a stream",
    },
    "tarfile.": {
        "evaluation/lpips/download": "a stream, of which one file is read",
        "sweep/packing": "writes a stream",
    },
    "gzip.": {"evaluation/lpips/download": "a stream, of which a bounded part is read"},
    "bz2.": {},
    "lzma.": {},
    "mmap.": {},
    "PIL.Image.open": {"capture/images": "a stream, of which a bounded part is decoded"},
    "numpy.load": {},
    "numpy.loadtxt": {},
    "numpy.genfromtxt": {},
    "numpy.fromfile": {},
    "numpy.memmap": {},
    "numpy.save": {},
    "numpy.savetxt": {},
    "numpy.savez": {
        "bench/loads": "writes a stream",
        "capture/frozen": "writes a stream",
        "evaluation/lpips/weights": "writes the user's cache",
    },
    "numpy.savez_compressed": {},
    "torch.load": {},
    "torch.save": {},
    "pandas.read_": {},
    "omegaconf.OmegaConf.load": {
        "cli/data": "the package's own config",
        "composing": "the package's own config",
    },
    "omegaconf.OmegaConf.save": {},
    "yaml.": {},
}


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
    assert used <= {"errors", "safeio", "splat"}


def aliases(tree: ast.AST) -> dict[str, str]:
    """The full name of everything that a file imports, by the name that it has there."""
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                first = alias.name.partition(".")[0]
                names[alias.asname or first] = alias.name if alias.asname else first
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    return names


def dotted(node: ast.AST) -> str:
    """A name with its attributes, as `np.load`; empty for any other expression."""
    if isinstance(node, ast.Name):
        return node.id
    inner = dotted(node.value) if isinstance(node, ast.Attribute) else ""
    return f"{inner}.{node.attr}" if inner and isinstance(node, ast.Attribute) else ""


def file_functions(source: str) -> set[str]:
    """The keys of `FILE_FUNCTIONS` that code uses, called or passed on."""
    tree = ast.parse(source)
    imported, used = aliases(tree), set()
    for node in ast.walk(tree):
        if not isinstance(node, (ast.Name, ast.Attribute)):
            continue
        first, _, rest = dotted(node).partition(".")
        name = imported.get(first, first) + (f".{rest}" if rest else "")
        exact = [key for key in FILE_FUNCTIONS if name == key]
        used |= set(exact or [key for key in FILE_FUNCTIONS if is_prefix(key, name)])
    return used


def is_prefix(key: str, name: str) -> bool:
    return key.endswith((".", "_")) and name.startswith(key)


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import numpy as np\nnp.load(file)", {"numpy.load"}),
        ("from numpy import load as l\nl(file)", {"numpy.load"}),
        ("import os\nmap(os.remove, files)", {"os.remove"}),
        ("import os.path\nos.path.exists(file)", {"os.path."}),
        ("import shutil\nshutil.rmtree(file)", {"shutil."}),
        ("import shutil\nshutil.copyfileobj(a, b)", {"shutil.copyfileobj"}),
        ("open(file)", {"open"}),
        ("import pandas as pd\npd.read_csv(file)", {"pandas.read_"}),
        ("from PIL import Image\nImage.open(file)", {"PIL.Image.open"}),
        ("import json\njson.dumps(1)\nfile.open()\nconfined(file).open()", set()),
    ],
)
def test_functions_that_reach_files_are_found(source: str, found: set[str]) -> None:
    assert file_functions(source) == found


def test_files_are_reached_through_safeio_alone() -> None:
    used = {
        (name, key)
        for name, path in FILES.items()
        if package_of(name) != "safeio"
        for key in file_functions(path.read_text(encoding="utf-8"))
    }
    allowed = {(name, key) for key, names in FILE_FUNCTIONS.items() for name in names}
    assert used - allowed == set(), "use xrgs.safeio, or say in FILE_FUNCTIONS why not"
    assert allowed - used == set(), "these exceptions are not needed any more"


def test_tables_and_figures_are_made_in_memory() -> None:
    """`to_csv` and `savefig` of pandas and matplotlib open files themselves if they are told to."""
    for name, path in FILES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if node.func.attr in {"to_csv", "to_json", "to_pickle", "to_parquet", "to_excel"}:
                assert not node.args, name
                assert "path_or_buf" not in {keyword.arg for keyword in node.keywords}, name
            if node.func.attr == "savefig":
                assert ast.unparse(node.args[0]) == "stream", name


def test_planning_and_reporting_run_without_torch() -> None:
    # One process for all: each further module is checked right after its import.
    script = (
        "import importlib, sys\n"
        f"for module in {LIGHT!r}:\n"
        "    importlib.import_module(f'xrgs.{module}')\n"
        "    heavy = {'torch', 'pycolmap', 'kornia', 'skimage', 'aiohttp'} & set(sys.modules)\n"
        "    assert not heavy, (module, heavy)\n"
    )
    subprocess.run([sys.executable, "-P", "-c", script], check=True)
