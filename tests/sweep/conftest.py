"""Fixtures of the tests of sweeps: a store, a session, and cells that a plan hands over."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import hydra
import pytest
from hydra.types import HydraContext
from omegaconf import DictConfig

from xrgs import config
from xrgs.config import Conf
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import Store
from xrgs.safeio.confined import ConfinedPath
from xrgs.sweep.session import HandOver, SweepSession
from xrgs.sweep.study import Study

#: The id of a variant that is not built.
VARIANT = "0123456789abcdef-0123456789abcdef"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty store, with the folder of one variant."""
    store = Store(tmp_path / "s")
    store.prepare()
    (store.variants / VARIANT).make_folder()
    return store


@pytest.fixture
def sick(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, int], None]:
    """(end of a path, number of an error) -> files with that end can't be read from now on.

    The number 0 makes all files readable again.
    """
    read = ConfinedPath._open_regular

    def sicken(end: str, number: int) -> None:
        def fail(path: ConfinedPath, flags: int) -> int:
            if number and str(path).endswith(end):
                raise OSError(number, os.strerror(number), str(path))
            return read(path, flags)

        monkeypatch.setattr(ConfinedPath, "_open_regular", fail)

    return sicken


class ConfigLoader:
    """Composes as Hydra's loader does, and counts."""

    def __init__(self, always: list[str]) -> None:
        self.always = always
        self.composed: list[list[str]] = []

    def load_sweep_config(self, _: DictConfig, overrides: list[str]) -> DictConfig:
        self.composed.append(overrides)
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            return hydra.compose("config", [*self.always, *overrides], return_hydra_config=True)


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Study]:
    """(*overrides) -> a study in the test's folder, all of whose cells have the overrides."""
    monkeypatch.chdir(tmp_path)

    def made(*overrides: str) -> Study:
        loader = ConfigLoader(list(overrides))
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            composed = hydra.compose("config", list(overrides), return_hydra_config=True)
        return Study(HydraContext(loader, None), len, composed)  # type: ignore[arg-type]

    return made


@pytest.fixture
def session(tmp_path: Path) -> SweepSession:
    """A call of `xrgs-sweep` that belongs to this process."""
    (tmp_path / "session").mkdir()
    session = SweepSession(tmp_path / "session")
    session.begin()
    return session


@pytest.fixture
def hand_over_of(compose: Callable[..., Conf], store: Store) -> Callable[..., HandOver]:
    """(**changes of the config) -> what a plan hands over for a cell with them."""
    given = ("scene=motorcycle", "splat.backend=torch", f"store={store.path}", "threads=1")
    conf = compose(*given)

    def made(**changes: object) -> HandOver:
        changed = replace(conf, **changes)  # type: ignore[arg-type]  # names of fields, as given
        return HandOver("motorcycle / a", asdict(changed), cell_identity(changed, VARIANT))

    return made
