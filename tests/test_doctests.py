"""The examples in docstrings give what they say.

An example uses the public names of `xrgs` and torch without importing them, a store `xrgs-store`, a
file `splats.ply`, `gaussians`, a `camera`, `data` to train on, and a `variant_id`.
"""

from __future__ import annotations

import doctest
import shutil
from importlib import import_module
from pathlib import Path

import pytest
import torch

import xrgs
from tests import reference_store
from xrgs.training.dataset import Dataset

PACKAGE = Path(xrgs.__file__).parent
MODULES = [
    f"xrgs.{file.relative_to(PACKAGE).with_suffix('').as_posix().replace('/', '.')}"
    for file in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store that examples read; each has a copy."""
    folder = tmp_path_factory.mktemp("examples") / "xrgs-store"
    reference_store.build(folder)
    return folder


@pytest.fixture
def names(
    data: Dataset, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> dict[str, object]:
    """The names that examples may use; the current folder has the files that they read."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(store, "xrgs-store")
    torch.manual_seed(0)
    points = torch.rand(50, 3) + torch.tensor([-0.5, -0.5, 2.0])
    gaussians = xrgs.Gaussians.from_points(points, torch.rand(50, 3))
    xrgs.save_gaussians("splats.ply", gaussians)
    K = torch.tensor([[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]])
    variant_id = next(Path("xrgs-store/variants").glob("[0-9a-f]*")).name
    given = {
        "camera": xrgs.Camera(torch.eye(4), K, 48, 32),
        "data": data,
        "gaussians": gaussians,
        "torch": torch,
        "variant_id": variant_id,
    }
    return given | {name: getattr(xrgs, name) for name in xrgs.__all__}


@pytest.mark.parametrize("module", MODULES)
def test_examples(module: str, names: dict[str, object]) -> None:
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner()
    examples = finder.find(import_module(module), extraglobs=names)
    assert any(example.examples for example in examples)
    for example in examples:
        assert runner.run(example).failed == 0, example.name


def test_every_public_name_has_an_example() -> None:
    without = {name for name in xrgs.__all__ if ">>> " not in (getattr(xrgs, name).__doc__ or "")}
    assert without == {"Render"}
