"""Fixtures of the commands' tests: commands in this process, and a store of a real sweep."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

import xrgs.report
from xrgs.mixture import variant
from xrgs.safeio.atomic import write_json
from xrgs.store.cell_folder import CellFolder
from xrgs.store.store import Store
from xrgs.sweep import job

#: Modules that take long to import, and that a plan and `--help` must do without.
HEAVY = ("kornia", "matplotlib", "pandas", "pycolmap", "scipy", "skimage", "torch")


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, str]]:
    """(folder) -> the digest of every file in it."""

    def read(folder: Path) -> dict[str, str]:
        return {
            file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
            for file in sorted(folder.rglob("*"))
            if file.is_file()
        }

    return read


@pytest.fixture(scope="session")
def photographs() -> Callable[..., Path]:
    """(folder, count, size) -> the folder with flat photographs, in which SIFT finds nothing."""

    def written(folder: Path, count: int, size: tuple[int, int] = (120, 90)) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(count):
            pixels = np.full((size[1], size[0], 3), 40 + number, np.uint8)
            Image.fromarray(pixels).save(folder / f"{number}.png")
        return folder

    return written


@pytest.fixture
def without_heavy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A PYTHONPATH where modules that take long to import raise an error."""
    folder = tmp_path_factory.mktemp("heavy")
    for name in HEAVY:
        (folder / f"{name}.py").write_text(f"raise ImportError('{name} was imported')")
    return os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])


@dataclass
class Children:
    """Stands in for the child processes of a sweep: variants and cells are made at once."""

    trained: list[str] = field(default_factory=list)
    """Ids of the cells that were trained, in order."""
    failures: dict[int, str] = field(default_factory=dict)
    """The error of cells that fail, by their seed."""
    unreachable: int | None = None
    """A number of Gaussians that no count-matched cell reaches."""
    gaussians: int = 100

    def run(self, work: str, request: Mapping[str, Any], *_: object) -> dict[str, Any]:
        if work == "variant":
            made = Store(Path(request["store"])).variants / "0123456789abcdef-0123456789abcdef"
            made.mkdir(parents=True)
            return {"variant": made.name}
        folder = CellFolder(Path(request["cell"]))
        conf = folder.config()
        self.trained.append(folder.id)
        if conf.seed in self.failures:
            raise job.WorkError(self.failures[conf.seed])
        if conf.components.count_matched.gaussians == self.unreachable:
            raise job.WorkError(f"no threshold gave {self.unreachable} Gaussians")
        finish(folder, gaussians=self.gaussians + len(self.trained))
        return {}

    def find(self, variants: Path, _: str) -> SimpleNamespace | None:
        names = [path.name for path in variants.glob("0123456789abcdef-*")]
        return SimpleNamespace(id=names[0]) if names else None


def finish(cell: CellFolder, gaussians: int) -> None:
    """Write the least that a done cell has."""
    (cell.path / "scores.csv").write_text("view,psnr\na,20\nb,22\n")
    times = {"training_time_s": 1.0, "render_time_ms": 1.0}
    sizes = {"memory_bytes": 1.0, "evaluations": 1.0, "steps": 8}
    write_json(cell.path / "summary.json", {"gaussians": gaussians} | times | sizes)
    cell.finish(["a", "b"], {})


@pytest.fixture
def children(monkeypatch: pytest.MonkeyPatch) -> Children:
    """Child processes that are not started, and a report that is not made."""
    made = Children()
    monkeypatch.setattr(job, "run_in_child", made.run)
    monkeypatch.setattr(variant, "find", made.find)
    monkeypatch.setattr(xrgs.report, "build", lambda *_: SimpleNamespace(text="the table"))
    return made


@pytest.fixture
def store(swept: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of that store, which a test may change."""
    shutil.copytree(swept[0] / "s", tmp_path / "s")
    return tmp_path / "s"
