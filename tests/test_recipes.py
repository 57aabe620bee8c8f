"""Follows each recipe of docs/extend.md to the letter, in a copy of the package.

The sentence before a block of the document says where the block goes, in words that readers see.
The copy comes first on the path of the commands that are then run as a contributor would run them.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import xrgs
from tests import forks
from xrgs.config import CONF_DIR

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
SMOKE = ("scene=motorcycle", "preset=smoke", "threads=1", "store=s")


@dataclass(frozen=True)
class Copy:
    """A copy of the package with its configs, in which recipes are followed."""

    root: Path
    forked: Callable[..., tuple[int, str, str]]
    """Runs a command in a process that imports the package of its PYTHONPATH."""

    def follow(self, recipe: str) -> None:
        """Put every block of a recipe where the sentence before it says."""
        text = RECIPES[recipe]
        blocks = BLOCK.findall(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
        # All blocks of code but those of a shell go somewhere; of a scene, one is an example.
        total = len(re.findall(r"^```(?!sh)\w+$", text, re.MULTILINE)) - (recipe == "scene")
        assert len(blocks) == total
        for new, name, side, anchor, with_head, block in blocks:
            file = self.root / (new or name)
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

    def edit(self, name: str, old: str, new: str) -> None:
        """Replace a text of a file of the package."""
        file = self.root / "xrgs" / name
        text = file.read_text()
        assert text.count(old) == 1
        file.write_text(text.replace(old, new))

    def run(self, command: str, *arguments: str) -> str:
        """Run `xrgs-<command>` of the copy in its root; return what it printed, without errors."""
        code, out, err = self.forked(command, self.root, *arguments, PYTHONPATH=str(self.root))
        assert code == 0, out + err
        return out + err

    def prove(self, *arguments: str) -> str:
        """Run `.ci/prove` on the copy's store `s`."""
        return self.run(str(ROOT / ".ci" / "prove"), "--store", "s", *arguments)


@pytest.fixture(scope="module")
def forked() -> Iterator[Callable[..., tuple[int, str, str]]]:
    """Processes of their own, which have imported all but the package."""
    with forks.server(*forks.LIBRARIES) as run:
        yield run


@pytest.fixture(scope="module")
def trained(
    tmp_path_factory: pytest.TempPathFactory,
    smoke_variants: Path,
    forked: Callable[..., tuple[int, str, str]],
) -> Path:
    """The root of a copy with a store `s` of two trained cells."""
    root = tmp_path_factory.mktemp("trained")
    ignored = shutil.ignore_patterns("__pycache__", "conf", "sweeps")
    shutil.copytree(Path(xrgs.__file__).parent, root / "xrgs", ignore=ignored)
    shutil.copytree(CONF_DIR, root / "conf", ignore=shutil.ignore_patterns("sweeps"))
    sweeps = CONF_DIR / "sweeps"
    shutil.copytree(sweeps if sweeps.is_dir() else CONF_DIR.parent / "sweeps", root / "sweeps")
    shutil.copytree(ROOT / "hydra_plugins", root / "hydra_plugins")
    shutil.copytree(smoke_variants, root / "s" / "variants")
    Copy(root, forked).run("sweep", "+ablation=consistency", *SMOKE)
    return root


@pytest.fixture
def copy(trained: Path, tmp_path: Path, forked: Callable[..., tuple[int, str, str]]) -> Copy:
    """A copy of that root for one test."""
    return Copy(shutil.copytree(trained, tmp_path / "copy", symlinks=True), forked)


def done_cells(copy: Copy, *arguments: str) -> str:
    """The plan's first line of the sweep that `trained` has run, after an edit."""
    printed = copy.run("sweep", "+ablation=consistency", *SMOKE, "dry_run=true", *arguments)
    return next(line for line in printed.splitlines() if line.startswith("plan:"))


def test_every_recipe_is_followed_by_a_test() -> None:
    followed = re.findall(
        r'^    copy\.follow\("(\w+)"\)$', Path(__file__).read_text(), re.MULTILINE
    )
    assert sorted(followed) == sorted(RECIPES)
    assert (ROOT / "docs/extend.md").read_text().count("\n## ") == len(RECIPES)


def test_an_ablation(copy: Copy) -> None:
    copy.follow("ablation")
    printed = copy.run("sweep", "+ablation=half_weight", *SMOKE, "dry_run=true")
    assert "plan: 2 cells, 1 done" in printed
    assert "half_weight" in printed


def test_a_component(copy: Copy) -> None:
    copy.follow("component")
    assert "2 cells, 2 done" in done_cells(copy)  # what is off is in no id
    printed = copy.run("sweep", "components.fade.weight=0.1", *SMOKE)
    assert "fade.weight=0.1 against baseline" in printed
    explained = copy.run("sweep", "help=components.fade")
    assert "of the mean opacity in the loss; 0 is off" in explained
    assert "plugin" not in explained
    assert "entry points" in copy.run("sweep", "help=components.plugins")


def test_a_metric_is_added_rescored_and_in_the_table(copy: Copy) -> None:
    copy.follow("metric")
    assert "2 cells, 2 done" in done_cells(copy)
    splats = {f: f.read_bytes() for f in (copy.root / "s").rglob("splats.ply")}
    assert "scored 2 cells anew" in copy.run("store", "rescore", "--store", "s")
    assert {f: f.read_bytes() for f in splats} == splats
    table = copy.run("report", "--store", "s")
    row = next(line for line in table.splitlines() if line.startswith("MAE"))
    assert re.search(r"0\.\d+ +0\.\d+", row)
    again = copy.run("store", "rescore", "--store", "s")
    assert "2 cells had the scores of this code already" in again
    assert "2 cells, 2 done" in done_cells(copy)
    copy.run("store", "check", "--store", "s")


def test_a_refactoring_is_proven_and_keeps_its_cells(copy: Copy) -> None:
    file = copy.root / "xrgs/safeio/refactorings.json"
    before = json.loads(file.read_text())
    copy.edit("splat/settings.py", "NOMINAL_STEPS = 30_000", "NOMINAL_STEPS = 3 * 10_000")
    assert "2 cells, 0 done" in done_cells(copy)
    printed = copy.prove("--sample", "1")
    assert "1 cell trained again, the same bit for bit" in printed
    declared = json.loads(file.read_text())
    assert len(declared["core"]) == len(before["core"]) + 1
    assert {**declared, "core": before["core"]} == before
    assert "2 cells, 2 done" in done_cells(copy)


def test_a_change_of_a_number_is_not_declared(copy: Copy) -> None:
    file = copy.root / "xrgs/safeio/refactorings.json"
    before = file.read_bytes()
    copy.edit("splat/settings.py", "NOMINAL_STEPS = 30_000", "NOMINAL_STEPS = 29_000")
    with pytest.raises(AssertionError, match="nothing is declared"):
        copy.prove("--sample", "1")
    assert file.read_bytes() == before


def test_a_refactoring_of_the_code_of_variants_is_proven_and_keeps_variants_and_cells(
    copy: Copy,
) -> None:
    before = json.loads((copy.root / "xrgs/safeio/refactorings.json").read_text())
    copy.edit("mixture/sfm.py", "_TOTAL_FEATURES = 100_000", "_TOTAL_FEATURES = 100 * 1_000")
    assert "2 cells, 0 done" in done_cells(copy)
    printed = copy.prove()
    assert "1 variant built again, the same bit for bit" in printed
    declared = json.loads((copy.root / "xrgs/safeio/refactorings.json").read_text())
    assert "declared in refactorings.json: variant/core\n" in printed
    assert len(declared["variant/core"]) == len(before["variant/core"]) + 1
    assert "2 cells, 2 done" in done_cells(copy)
    # A variant that the refactored code had built before it was declared is of equal code as well.
    (file,) = (copy.root / "s" / "variants").glob("*/variant.json")
    (new,) = declared["variant/core"].keys() - before["variant/core"].keys()
    content = json.loads(file.read_text())
    content["code"]["core"] = new
    file.write_text(json.dumps(content))
    with pytest.raises(AssertionError, match="no done cell was trained with other code"):
        copy.prove()


def test_other_cameras_are_not_declared(copy: Copy) -> None:
    file = copy.root / "xrgs/safeio/refactorings.json"
    before = file.read_bytes()
    copy.edit("mixture/sfm.py", "_SMALL_SIDE = 800", "_SMALL_SIDE = 8")
    with pytest.raises(AssertionError, match="views, files differ; nothing is declared"):
        copy.prove()
    assert file.read_bytes() == before
    assert "2 cells, 0 done" in done_cells(copy)


def test_a_scene_kind(copy: Copy) -> None:
    copy.follow("scene")
    assert "2 cells, 2 done" in done_cells(copy)
    photographs = sorted((copy.root / "s" / "variants").glob("*/images/test/*.png"))
    (copy.root / "pair.txt").write_text("\n".join(map(str, photographs)))
    arguments = ("scene=listed", "scene.path=pair.txt", "preset=smoke", "store=s", "dry_run=true")
    printed = copy.run("sweep", *arguments, "variant.test_every=0")  # two views are to train on
    assert "variant not built" in printed
    assert "pair.txt / baseline" in printed


def test_a_degradation(copy: Copy) -> None:
    copy.follow("degradation")
    assert "2 cells, 2 done" in done_cells(copy)
    overrides = ("scene=motorcycle", "preset=smoke", "store=s", "variant.degradation=grey")
    printed = copy.run("data", "inspect", *overrides)
    assert "motorcycle_right" in printed


def test_a_launcher(copy: Copy) -> None:
    copy.follow("launcher")
    (copy.root / "hydra_plugins" / "pool_launcher.py").write_text(
        "from dataclasses import dataclass\n"
        "from hydra._internal.core_plugins.basic_launcher import BasicLauncher\n"
        "from hydra.core.config_store import ConfigStore\n\n\n"
        "@dataclass\nclass Conf:\n"
        "    _target_: str = 'hydra_plugins.pool_launcher.PoolLauncher'\n"
        "    workers: int = 2\n\n\n"
        "class PoolLauncher(BasicLauncher):\n"
        "    def __init__(self, workers: int) -> None:\n"
        "        super().__init__()\n\n\n"
        "ConfigStore.instance().store(group='hydra/launcher', name='pool', node=Conf)\n"
    )
    printed = copy.run("sweep", *SMOKE[:2], "store=s", "train.steps=2", "hydra/launcher=pool")
    assert "hydra/launcher=pool: 1 cell, threads=" in printed
    assert "Page: s/reports/" in printed
