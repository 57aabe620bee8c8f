"""Fixtures of the tests of sweeps: a store, its cells, a session, and files that can't be read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hydra
import msgspec
import pytest
from hydra.types import HydraContext
from omegaconf import DictConfig

import xrgs.report
from xrgs import config
from xrgs.config import Conf
from xrgs.runtime import lease
from xrgs.safeio.atomic import write_json
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_id, cell_identity
from xrgs.store.schema import RecordedCell
from xrgs.store.store import Store
from xrgs.sweep.axes import CellSpec
from xrgs.sweep.job import SweepSession
from xrgs.sweep.plan import PlannedCell
from xrgs.sweep.study import Study

#: The id of a variant that is not built.
VARIANT = "0123456789abcdef-0123456789abcdef"
SUMMARY = {
    "training_time_s": 1.5,
    "render_time_ms": 2.0,
    "gaussians": 7,
    "memory_bytes": 1000,
    "evaluations": 500,
    "steps": 20,
}


def content(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Inode, time and bytes of every file of a folder."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    stats = {file: file.stat() for file in files}
    return {
        file.relative_to(folder).as_posix(): (stat.st_ino, stat.st_mtime_ns, file.read_bytes())
        for file, stat in stats.items()
    }


def planned(conf: Conf, label: str, *shared: str) -> PlannedCell:
    """A cell of the variant `v`."""
    identity = cell_identity(conf, "v")
    return PlannedCell(CellSpec(label, "", shared, ()), conf, "v", identity, cell_id(identity))


def finish(store: Store, name: str) -> None:
    """Write the least that a done cell has."""
    cell = store.cell(name)
    (cell.path / "scores.csv").write_text("view\na\n")
    cell.finish(["a"], {})


@pytest.fixture
def faulty(
    sweep_here: Callable[..., tuple[int, str, str]],
    smoke_variants: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str], Callable[..., tuple[int, str, str]]]:
    """(Python code) -> the function (*overrides) that runs a smoke sweep in this process.

    All processes that it starts run the code first. The test's folder has the store `s` with the
    variant, and no report is made.
    """

    def made(code: str) -> Callable[..., tuple[int, str, str]]:
        shutil.copytree(smoke_variants, tmp_path / "s" / "variants")
        (tmp_path / "site").mkdir()
        (tmp_path / "site" / "sitecustomize.py").write_text(code)
        path = [str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")]
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, path)))
        monkeypatch.setenv("SWEEPS_OF", str(tmp_path))
        monkeypatch.setattr(xrgs.report, "build", lambda *_: SimpleNamespace(text=""))
        return partial(sweep_here, "scene=motorcycle", "preset=smoke", "store=s")

    return made


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty store, with the folder of one variant."""
    store = Store(tmp_path / "s")
    store.prepare()
    (store.variants / VARIANT).mkdir()
    return store


@dataclass(frozen=True)
class Cells:
    """Plans, begins and finishes cells of a store, without any training."""

    store: Store
    conf: Conf

    def plan(
        self, name: str | None = None, identity: Mapping[str, Any] | None = None, **changes: Any
    ) -> CellFolder:
        """Plan a cell, as a sweep does.

        `name` replaces its id, `identity` changes values of its identity, and `changes` are of its
        config.
        """
        conf = replace(self.conf, **changes)
        made = msgspec.structs.replace(cell_identity(conf, VARIANT), **(identity or {}))
        cell = self.store.cell(name or cell_id(made))
        plan_cell(cell, conf, made)
        return cell

    def begin(self, *given: Any, **changes: Any) -> CellFolder:
        """Plan a cell and begin an attempt; arguments as for `plan`."""
        cell = self.plan(*given, **changes)
        assert begin_attempt(cell)
        return cell

    def finish(self, cell: CellFolder, gaussians: int = 7) -> CellFolder:
        """Write the results of a cell that has begun."""
        (cell.path / "scores.csv").write_text("view,psnr\na,20\n")
        write_json(cell.path / "summary.json", SUMMARY | {"gaussians": gaussians})
        cell.finish(["a"], {})
        return cell

    def done(self, *given: Any, **changes: Any) -> CellFolder:
        """Plan, begin and finish a cell; arguments as for `plan`."""
        return self.finish(self.begin(*given, **changes))

    def record(self, *rows: tuple[str | None, str, str], **more: Any) -> str:
        """Write the record of a sweep of cells (id, scene, label), and return the sweep's id."""
        return self.store.write_sweep([], [self.row(*row, **more) for row in rows])

    def row(self, cell_id: str | None, scene: str, label: str, **more: Any) -> RecordedCell:
        """A cell in the record of a sweep."""
        names = {"condition": "", "variant_seed": 0, "seed": 0}
        ids = {"variant_id": None, "baseline_id": None}
        given: dict[str, Any] = names | ids | more
        return RecordedCell(cell_id=cell_id, scene=scene, label=label, **given)


@pytest.fixture
def cells(compose: Callable[..., Conf], store: Store) -> Cells:
    """The cells of `store`, of a config on the torch backend."""
    given = ("scene=motorcycle", "splat.backend=torch", f"store={store.path}", "threads=1")
    return Cells(store, compose(*given))


@cache
def _hydra_config(overrides: tuple[str, ...]) -> DictConfig:
    with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
        return hydra.compose("config", list(overrides), return_hydra_config=True)


def hydra_config(*overrides: str) -> DictConfig:
    """Compose a sweep's config with Hydra's own part; equal ones once, each takes 0.1 s."""
    return deepcopy(_hydra_config(overrides))


class ConfigLoader:
    """Composes as Hydra's loader does, and counts."""

    def __init__(self, always: tuple[str, ...]) -> None:
        self.always = always
        self.composed: list[list[str]] = []

    def load_sweep_config(self, _: DictConfig, overrides: list[str]) -> DictConfig:
        self.composed.append(overrides)
        return hydra_config(*self.always, *overrides)


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Study]:
    """(*overrides) -> a study in the test's folder, all of whose cells have the overrides."""
    monkeypatch.chdir(tmp_path)

    def made(*overrides: str) -> Study:
        context = HydraContext(ConfigLoader(overrides), None)  # type: ignore[arg-type]
        return Study(context, len, hydra_config(*overrides))

    return made


@pytest.fixture
def session(tmp_path: Path) -> SweepSession:
    """A call of `xrgs-sweep` that belongs to this process."""
    (tmp_path / "session").mkdir()
    lease.sign(tmp_path / "session" / "sweep")
    return SweepSession(tmp_path / "session")
