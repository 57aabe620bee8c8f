"""Follows the recipes of docs/extend.md to the letter, in a copy of the package, and `.ci/prove`.

The sentence before a block of the document says where the block goes, in words that readers see.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

import xrgs
from tests.conftest import work_here
from xrgs.config import CONF_DIR
from xrgs.errors import XrgsError
from xrgs.mixture import saved_variant
from xrgs.safeio import code, refactorings
from xrgs.safeio.atomic import write_json
from xrgs.store import identity, scoring
from xrgs.store.store import Store
from xrgs.sweep import build_variants, job

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
#: Sentence and block: the new file, or the file and the line before or after which the block goes
#: (before the decorator or the comment of the line, where it says so), and the block's text.
BLOCK = re.compile(
    r"(?:new file `([^`]+)`|in `([^`]+)`\s+(before|after) `([^`]+)`( and its \w+)?):\n\n"
    r"```\w+\n(.*?)```",
    re.DOTALL,
)
#: The sections of the document by their last words, as "component" of "Add a component".
RECIPES: dict[str, str] = dict(
    re.findall(
        r"^## Add an? (\w+)\n(.*?)(?=^## |\Z)",
        (ROOT / "docs/extend.md").read_text(encoding="utf-8"),
        re.MULTILINE | re.DOTALL,
    )
)
#: The cells of `swept`, by one more ablation.
SWEEP = ("scene=motorcycle", "preset=smoke", "train.steps=8", "threads=1", "store=s")
#: Runs commands of the package that comes first on the path, one after another, in one process.
_COMMANDS = """
import json, sys
from importlib import import_module
from importlib.machinery import PathFinder
sys.meta_path.insert(0, PathFinder)  # before that of an editable installation
from tests.conftest import work_here
from xrgs.sweep import job
job.run_in_child = work_here
for name, *words in json.loads(sys.argv[1]):
    print(f"== {name} {words[0]}", flush=True)
    sys.argv = [f"xrgs-{name}", *words]
    try:
        import_module(f"xrgs.cli.{name}").main()
    except SystemExit as end:
        assert not end.code, end.code
"""
_LAUNCHER = """
from dataclasses import dataclass
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.config_store import ConfigStore

@dataclass
class Conf:
    _target_: str = "hydra_plugins.pool_launcher.PoolLauncher"
    workers: int = 2

class PoolLauncher(BasicLauncher):
    def __init__(self, workers: int) -> None:
        super().__init__()

ConfigStore.instance().store(group="hydra/launcher", name="pool", node=Conf)
"""


def follow(root: Path, recipe: str) -> None:
    """Put every block of a recipe where the sentence before it says."""
    text = RECIPES[recipe]
    blocks = BLOCK.findall(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
    # All blocks of code but those of a shell go somewhere; of a scene, one is an example.
    total = len(re.findall(r"^```(?!sh)\w+$", text, re.MULTILINE)) - (recipe == "scene")
    assert len(blocks) == total
    for new, name, side, anchor, with_head, block in blocks:
        file = root / (new or name)
        if new:
            assert not file.exists()
            file.write_text(block)
            continue
        lines = file.read_text().splitlines(keepends=True)
        (at,) = (n for n, line in enumerate(lines) if line.strip().startswith(anchor))
        at += side == "after"
        while with_head and lines[at - 1].strip().startswith(("#", "@")):
            at -= 1
        lines[at:at] = block.splitlines(keepends=True)
        file.write_text("".join(lines))


@pytest.fixture
def root(tmp_path: Path, swept: tuple[Path, str]) -> Path:
    """A copy of the package with its configs, and with a store `s` of two trained cells."""
    root, ignored = tmp_path / "copy", shutil.ignore_patterns("__pycache__", "conf", "sweeps")
    shutil.copytree(Path(xrgs.__file__).parent, root / "xrgs", ignore=ignored)
    shutil.copytree(CONF_DIR, root / "conf", ignore=shutil.ignore_patterns("sweeps"))
    sweeps = CONF_DIR / "sweeps"
    shutil.copytree(sweeps if sweeps.is_dir() else CONF_DIR.parent / "sweeps", root / "sweeps")
    shutil.copytree(ROOT / "hydra_plugins", root / "hydra_plugins")
    shutil.copytree(swept[0] / "s", root / "s")
    return root


def test_every_recipe_is_followed_and_keeps_all_cells(root: Path) -> None:
    """By commands of the copy, which comes first on the path, as a contributor would run them."""
    assert (ROOT / "docs/extend.md").read_text().count("\n## ") == len(RECIPES) == 6
    for recipe in RECIPES:
        follow(root, recipe)
    (root / "hydra_plugins" / "pool_launcher.py").write_text(_LAUNCHER)
    photographs = sorted((root / "s" / "variants").glob("*/images/test/*.png"))
    (root / "pair.txt").write_text("\n".join(map(str, photographs)))
    splats = {file: file.read_bytes() for file in (root / "s").rglob("splats.ply")}
    listed = (
        "scene=listed",
        "scene.path=pair.txt",
        "preset=smoke",
        "variant.test_every=0",
        "variant.min_hr=1",
    )
    commands = [
        ("sweep", "+ablation=consistency,half_weight", *SWEEP, "dry_run=true"),
        ("store", "rescore", "--store", "s"),
        ("sweep", "components.fade.weight=0.1", *SWEEP, "hydra/launcher=pool"),
        ("sweep", "help=components"),
        ("data", "inspect", *listed, "variant.degradation=grey", "store=s"),
    ]
    done = subprocess.run(
        [sys.executable, "-P", "-c", _COMMANDS, json.dumps(commands)],
        cwd=root,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(ROOT)])},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    planned, rescored, trained, explained, inspected = re.split(
        "^== ", done.stdout, flags=re.MULTILINE
    )[1:]
    assert "plan: 3 cells, 2 done" in planned  # what is off is in no id
    assert "half_weight" in planned
    assert "scored 2 cells anew" in rescored
    assert {file: file.read_bytes() for file in splats} == splats
    assert "fade.weight=0.1 against baseline" in trained
    assert "hydra/launcher=pool: 1 cell, threads=" in trained
    (row,) = (line for line in trained.splitlines() if line.startswith("MAE"))
    assert re.search(r"0\.\d+ +0\.\d+", row)
    fade, plugins = re.findall(
        r"^components\.(?:fade\.weight|plugins)\b.*\n((?:  .*\n)*)", explained, re.MULTILINE
    )
    assert "of the mean opacity in the loss; 0 is off" in fade
    assert "entry points" in plugins
    assert "motorcycle_right" in inspected
    (manifest,) = set((root / "s" / "variants").glob("*/variant.json")) - {
        file.parents[2] / "variant.json" for file in photographs
    }
    (low,) = (view for view in saved_variant.load(manifest.parent).views if view.tag == "LR")
    with Image.open(low.file) as image:
        pixels = np.asarray(image).astype(int)
    assert np.ptp(pixels, axis=-1).max() == 0


@pytest.fixture(scope="module")
def prove() -> ModuleType:
    """`.ci/prove` as a module."""
    spec = spec_from_loader("prove", SourceFileLoader("prove", str(ROOT / ".ci" / "prove")))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["prove"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def store(root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """The store of `root`, whose code is hashed in place of the installed package's."""
    monkeypatch.setattr(code, "PACKAGE", root / "xrgs")
    monkeypatch.setattr(refactorings, "FILE", root / "xrgs/safeio/refactorings.json")
    caches = (identity.training_code, scoring.scoring_code)
    for cached in caches:
        cached.cache_clear()
    yield Store(root / "s")
    for cached in caches:
        cached.cache_clear()


def edit(store: Store, name: str, old: str, new: str) -> None:
    """Replace a text of a file of the copy."""
    file = store.path.parent / "xrgs" / name
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))


@pytest.mark.usefixtures("here")
def test_a_refactoring_is_proven_and_keeps_cells_and_variants(
    prove: ModuleType, store: Store
) -> None:
    before, cells = refactorings.declared(), store.cell_folders()
    edit(store, "splat/settings.py", "NOMINAL_STEPS = 30_000", "NOMINAL_STEPS = 3 * 10_000")
    edit(store, "mixture/sfm.py", "_TOTAL_FEATURES = 100_000", "_TOTAL_FEATURES = 100 * 1_000")
    assert all(identity.changed_code(cell.identity()) == ["core"] for cell in cells)
    printed = prove.prove(store, cells, 1)
    assert "1 cell trained again, 1 variant built again, the same bit for bit" in printed
    assert printed.endswith("declared in refactorings.json: core, variant/core")
    declared = refactorings.declared()
    for part in ("core", "variant/core"):
        assert len(declared[part]) == len(before[part]) + 1
    assert declared | {part: before[part] for part in ("core", "variant/core")} == before
    assert all(identity.changed_code(cell.identity()) == [] for cell in cells)
    # A variant that the refactored code had built before it was declared is of equal code as well.
    (file,) = store.variants.glob("*/variant.json")
    (new,) = declared["variant/core"].keys() - before["variant/core"].keys()
    content = json.loads(file.read_text())
    content["code"]["core"] = new
    file.write_text(json.dumps(content))
    with pytest.raises(XrgsError, match="no done cell was trained with other code"):
        prove.prove(store, cells, 1)


def test_other_numbers_and_views_are_not_declared(
    prove: ModuleType, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = refactorings.FILE.read_bytes()

    def other_splats(work: str, request: Mapping[str, Any], *_: object) -> dict[str, Any]:
        result = work_here(work, request)
        splats = Path(request["cell"]) / "splats.ply"
        splats.write_bytes(splats.read_bytes()[:-1] + b"x")
        return result

    def other_variant(_: object, other: Store) -> str:
        (folder,) = store.variants.iterdir()
        manifest = saved_variant.read_manifest(folder)
        changed = msgspec.structs.replace(manifest, files=dict.fromkeys(manifest.files, "0" * 64))
        changed = msgspec.structs.replace(changed, id=changed.computed_id())
        (other.variants / changed.id).mkdir()
        write_json(other.variants / changed.id / "variant.json", msgspec.to_builtins(changed))
        return changed.id

    monkeypatch.setattr(job, "run_in_child", other_splats)
    edit(store, "splat/settings.py", "NOMINAL_STEPS = 30_000", "NOMINAL_STEPS = 29_000")
    with pytest.raises(XrgsError, match=r"splats\.ply.*; nothing is declared"):
        prove.prove(store, store.cell_folders(), 1)
    monkeypatch.setattr(build_variants, "build", other_variant)
    edit(store, "mixture/sfm.py", "_SMALL_SIDE = 800", "_SMALL_SIDE = 8")
    with pytest.raises(XrgsError, match="files differ; nothing is declared"):
        prove.prove(store, store.cell_folders(), 1)
    assert refactorings.FILE.read_bytes() == before
