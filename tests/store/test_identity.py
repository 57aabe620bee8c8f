"""Tests that a cell's identity has everything that can change a trained number, and nothing else.

Code is edited in a copy of the package, whose digests then stand for the installed package's.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from xrgs import config
from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.evaluation import metrics
from xrgs.registry import BUILT_IN, file_of
from xrgs.safeio import code, refactorings
from xrgs.splat import backend
from xrgs.splat.backend import resolve_backend
from xrgs.store import identity, scoring

pytest.importorskip("xrgs._native", reason="the kernels were not built")

PACKAGE = Path(identity.__file__).parents[1]


def cell_id(conf: Conf, variant: str = "v") -> str:
    return identity.cell_id(identity.cell_identity(conf, variant))


@pytest.fixture(scope="module")
def confs(compose: Callable[..., Conf]) -> dict[str, Conf]:
    """Configs with and without a component, on both backends."""
    arms = {"baseline": (), "mip": ("+ablation=mip",)}
    return {
        f"{arm} {backend}": compose(*changes, f"splat.backend={backend}")
        for arm, changes in arms.items()
        for backend in ("torch", "native")
    }


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the package's source, which is hashed instead of the installed one."""
    ignored = shutil.ignore_patterns("*.so", "__pycache__", "html")
    home = shutil.copytree(PACKAGE, tmp_path / "xrgs", ignore=ignored)
    monkeypatch.setattr(code, "PACKAGE", home)
    monkeypatch.setattr(refactorings, "FILE", home / "safeio" / "refactorings.json")
    caches = (identity.training_code, scoring.scoring_code)
    for cached in caches:
        cached.cache_clear()
    yield home
    for cached in caches:
        cached.cache_clear()


def ids_after(edit: Callable[[], object], confs: dict[str, Conf]) -> tuple[set[str], set[str]]:
    """Make an edit; return the names of configs whose id is the same and is another one."""
    before = {name: cell_id(conf) for name, conf in confs.items()}
    edit()
    identity.training_code.cache_clear()
    same = {name for name, conf in confs.items() if cell_id(conf) == before[name]}
    return same, confs.keys() - same


def edited(file: Path, old: str, new: str) -> Callable[[], object]:
    text = file.read_text()
    assert old in text
    return lambda: file.write_text(text.replace(old, new, 1))


# 1. Words don't count.


def test_words_change_no_id(package: Path, confs: dict[str, Conf]) -> None:
    for name, old, new in (
        ("training/loop.py", '"""The training loop', '"""The loop of training'),
        ("training/loop.py", "if TYPE_CHECKING:\n", "if TYPE_CHECKING:\n    import decimal\n"),
        ("splat/optimizer.py", "import math\n", "import math\nfrom typing import Protocol\n"),
        ("splat/optimizer.py", "    def __init__(\n", "    # Words.\n    def __init__(\n"),
        ("csrc/isa.h", "#pragma once\n", "#pragma once\n// A word\n/* and\n others */\n\n"),
    ):
        assert ids_after(edited(package / name, old, new), confs)[1] == set(), (name, new)


@pytest.mark.slow
def test_every_python_version_gives_the_same_digest() -> None:
    """Tokens of f-strings and the dump of a syntax tree differ between versions."""
    expected = code.code_digest("splat", "training", "csrc", "report")
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); from xrgs.safeio import code;"
        "print(code.code_digest('splat', 'training', 'csrc', 'report'))"
    )
    compared = 0
    for minor in range(11, 20):
        if (python := shutil.which(f"python3.{minor}")) is None:
            continue
        command = [python, "-I", "-c", script, str(PACKAGE.parent)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:  # a version manager's stub may name a version that is not there
            assert done.stdout.strip() == expected, python
            compared += 1
    if not compared:
        pytest.skip("no python3.N of 3.11 or later is on the path")


# 2. What is off is absent.


def test_a_new_component_metric_scene_and_key_change_no_id(
    package: Path, confs: dict[str, Conf], monkeypatch: pytest.MonkeyPatch
) -> None:
    def add() -> None:
        (package / "training/components/new.py").write_text("class New: ...\n")
        (package / "evaluation/metrics/new.py").write_text("def new(a, b): return 0.0\n")
        (package / "photos/scenes/new.py").write_text("def names(conf): return []\n")

    assert ids_after(add, confs)[1] == set()
    new_key = dataclasses.make_dataclass(
        "TrainConf", [("new", float, config.off(0.0))], bases=(type(confs["mip torch"].train),),
        kw_only=True,
    )  # fmt: skip
    for conf in confs.values():
        before = cell_id(conf)
        wider = dataclasses.replace(conf, train=new_key(**vars(conf.train), new=0.0))
        assert cell_id(wider) == before
        wider.train.new = 1.0  # type: ignore[attr-defined]
        assert cell_id(wider) != before


def leaves(value: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return [leaf for f in fields for leaf in leaves(getattr(value, f.name), (*path, f.name))]
    return [path]


def change(conf: Any, path: tuple[str, ...]) -> None:
    """Set another value of the same type at a path of a config."""
    for name in path[:-1]:
        conf = getattr(conf, name)
    match old := getattr(conf, path[-1]):
        case bool():
            new: Any = not old
        case int() | float():
            new = old + 1
        case str():
            new = old + "x"
        case None:
            new = "x"
        case dict():
            new = {**old, "x": {}}
        case _:
            new = type(old)(value + 1 for value in old)
    setattr(conf, path[-1], new)


def test_every_value_of_training_counts_where_it_is_on(baseline: Conf) -> None:
    """A key of a component that is off counts only where it switches the component on."""
    assert cell_id(baseline, "v") != cell_id(baseline, "w")
    auto, named = copy.deepcopy(baseline), copy.deepcopy(baseline)
    auto.splat.backend, named.splat.backend = "auto", resolve_backend("auto")
    assert cell_id(auto) == cell_id(named)
    paths = [p for p in leaves(baseline) if p[:2] not in {("splat", "backend")}]
    assert len(paths) > 60
    for path in paths:
        if path == ("components", "plugins"):  # its package would have to be installed
            continue
        changed = copy.deepcopy(baseline)
        change(changed, path)
        group = getattr(changed.components, path[1]) if path[0] == "components" else None
        counts = path[0] in {"splat", "train", "seed"} or (group and config.is_on(group))
        assert (cell_id(changed) != cell_id(baseline)) == bool(counts), path


# 3. Components where they are on, the core always, kernels where they train.


def test_code_counts_where_it_is_used(
    package: Path, confs: dict[str, Conf], compose: Callable[..., Conf]
) -> None:
    known = confs | {"dense": compose("splat.init=dense"), "mcmc": compose("+ablation=mcmc")}
    on_kernels = {name for name, conf in known.items() if not name.endswith("torch")}
    kernels = next(file for file in sorted((package / "csrc").rglob("*.cpp")))
    for name, old, new, changed in (
        ("training/components/mip.py", "N = 0.15", "N = 0.16", {"mip torch", "mip native"}),
        ("training/dense/depths.py", "_STEP = 0.35", "_STEP = 0.36", {"dense"}),
        ("splat/strategy/mcmc.py", "", "", {"mcmc"}),
        ("splat/strategy/default.py", "", "", known.keys() - {"mcmc"}),
        ("splat/strategy/ops.py", "", "", known.keys()),  # that both import
        ("splat/settings.py", "NOMINAL_STEPS = 30_000", "NOMINAL_STEPS = 30_001", known.keys()),
        ("training/loop.py", "steps / NOMINAL_STEPS", "steps // NOMINAL_STEPS", known.keys()),
        (
            *("training/loop.py", "from xrgs.splat.loss import Target"),
            *("from xrgs.splat.native.loss import Target", known.keys()),
        ),
        (str(kernels.relative_to(package)), "", "", on_kernels),
    ):
        file = package / name
        edit = edited(file, old, new) if old else partial(append, file)
        assert ids_after(edit, known)[1] == changed, name


def append(file: Path) -> None:
    """Add a number at the end of a source file, which may be new."""
    before = file.read_text() if file.exists() else ""
    more = "static int more = 1;\n" if file.suffix == ".cpp" else "MORE = 1\n"
    file.write_text(f"{before}\n{more}")


def test_the_renderer_of_gsplat_and_its_version_count_where_it_renders(
    package: Path, confs: dict[str, Conf], monkeypatch: pytest.MonkeyPatch
) -> None:
    alpha_max = {"1.5.3": 0.999, "1.6.0": 0.99}
    version = ["1.5.3"]
    monkeypatch.setattr(backend, "_gsplat_version", lambda: (version[0], alpha_max[version[0]]))
    on_gsplat = copy.deepcopy(confs["baseline torch"])
    on_gsplat.splat.backend = "gsplat"
    with pytest.raises(XrgsError, match=r"splat\.raster\.alpha_max=0\.99: .*gsplat 1\.5\.3"):
        cell_id(on_gsplat)
    version[0] = "1.6.0"
    on_160 = cell_id(on_gsplat)
    on_gsplat.splat.raster.alpha_max, version[0] = 0.999, "1.5.3"
    known = {"gsplat": on_gsplat, **confs}
    assert len({on_160, *map(cell_id, known.values())}) == 2 + len(confs)
    file = package / "splat" / "gsplat" / "rasterizer.py"
    edit = edited(file, "packed=False", "packed=True")
    assert ids_after(edit, known) == (set(confs), {"gsplat"})


def test_every_file_of_the_model_and_of_training_counts_always_or_with_a_part() -> None:
    folders = identity.CODE
    counted = {*folders.core(), *(name for part in folders.parts for name in folders.part(part))}
    for file in code.sources(*folders.folders):
        name = file.relative_to(PACKAGE).as_posix()
        assert name in counted or name.startswith(folders.whole_parts), name


def test_a_file_that_is_added_counts_where_its_folder_does(
    package: Path, confs: dict[str, Conf]
) -> None:
    for name, backends in {
        "splat/new.py": {"torch", "native"},
        "training/new.py": {"torch", "native"},
        "splat/torch/new.py": {"torch"},
        "splat/native/new.py": {"native"},
        "csrc/new.cpp": {"native"},
        "splat/gsplat/new.py": set(),
        "training/dense/new.py": set(),
        "training/components/new.py": set(),
        "photos/new.py": set(),
        "evaluation/new.py": set(),
        "new.py": set(),
    }.items():
        changed = {conf for conf in confs if conf.split()[1] in backends}
        assert ids_after(partial(append, package / name), confs)[1] == changed, name
    # A file of components that a file of the core imports, and what that one imports.
    folder = package / "training/components"
    (folder / "new.py").write_text("from xrgs.training.components.newer import MORE\n")
    append(folder / "newer.py")
    loop = package / "training/loop.py"
    loop.write_text(f"{loop.read_text()}\nfrom xrgs.training.components import new\n")
    edit = edited(folder / "newer.py", "MORE = 1", "MORE = 2")
    assert ids_after(edit, confs)[1] == set(confs)


def test_what_a_component_imports_counts_with_it(package: Path) -> None:
    before = {key: identity.code_now("native", (key,))[key] for key in BUILT_IN}
    append(package / "training/components/adam.py")
    after = {key: identity.code_now("native", (key,))[key] for key in BUILT_IN}
    assert {key for key in before if after[key] != before[key]} == {"supersampled", "exposure"}
    # A part that was split off is absent until it changes: cells of before don't name it.
    assert "strategy/default" not in identity.code_now("native")
    append(package / "splat/strategy/default.py")
    assert "strategy/default" in identity.code_now("native")


def test_each_component_of_the_config_has_a_module() -> None:
    keys = {field.name for field in dataclasses.fields(config.ComponentsConf)}
    for key in keys - {"plugins", "count_matched"}:
        file = file_of(key)
        assert file is not None, key
        assert (PACKAGE / file).is_file(), key


# 4. Scores are apart.


def test_a_metric_makes_scores_stale_and_no_training(package: Path, confs: dict[str, Conf]) -> None:
    now = scoring.scoring_code()
    assert set(now) == {"protocol", *metrics.VIEW_METRICS}
    assert scoring.stale_scores(now) == []
    assert scoring.stale_scores({"protocol": now["protocol"]}) == list(metrics.VIEW_METRICS)
    edit = edited(package / "evaluation/metrics/psnr.py", "10 *", "11 *")
    assert ids_after(edit, confs)[1] == set()
    scoring.scoring_code.cache_clear()
    assert scoring.stale_scores(now) == ["psnr", "psnr_plain", "psnr_fitted"]


# 5. A declared refactoring keeps ids.


def test_a_declared_refactoring_keeps_all_ids(package: Path, confs: dict[str, Conf]) -> None:
    conf = confs["mip torch"]
    trained = identity.cell_identity(conf, "v")

    def refactor() -> None:
        edited(package / "splat/settings.py", "30_000", "3 * 10_000")()

    assert ids_after(refactor, confs)[0] == set()
    assert identity.changed_code(trained) == ["core"]
    exact = identity.current_code(trained)["core"]
    declared = refactorings.declared()
    declared["core"][exact] = trained.code["core"]
    refactorings.FILE.write_text(json.dumps(declared))
    assert identity.changed_code(trained) == []
    identity.training_code.cache_clear()
    assert identity.cell_id(identity.cell_identity(conf, "v")) == identity.cell_id(trained)
    # Cells that the refactored code had trained before it was declared are of equal code as well.
    early = msgspec.structs.replace(trained, code=trained.code | {"core": exact})
    assert identity.changed_code(early) == []


# 6. Of the machine the arithmetic counts.


def test_the_native_backend_on_a_machine_without_fused_multiply_add_is_another_cell(
    baseline: Conf,
) -> None:
    native = pytest.importorskip("xrgs._native")
    before, found = native.isa(), {}
    try:
        for isa in native.available_isas():
            native.set_isa(isa)
            ids = []
            for backend in ("native", "torch"):
                baseline.splat.backend = backend
                ids.append(cell_id(baseline))
            found[isa] = (native.fused_multiply_add(), *ids)
    finally:
        native.set_isa(before)
    assert all(fused for isa, (fused, *_) in found.items() if isa != "portable")
    for fused, on_native, on_torch in found.values():
        for other_fused, on_other_native, on_other_torch in found.values():
            assert (on_native == on_other_native) == (fused == other_fused)
            assert on_torch == on_other_torch


def test_a_native_module_that_cannot_be_loaded_is_an_error_of_one_line(
    baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Built for another Python or C library: the module is found, and its import fails."""
    baseline.splat.backend = "native"

    def fail(name: str) -> None:
        raise ImportError(f"{name}: version `GLIBC_9.9' not found")

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(XrgsError, match=r"splat\.backend=native: .*GLIBC_9\.9.*install xrgs"):
        cell_id(baseline)
