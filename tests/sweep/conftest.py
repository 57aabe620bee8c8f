"""Fixtures of the tests of sweeps: a store, a session, and cells that a plan hands over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from xrgs.config import Conf
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import Store
from xrgs.sweep.session import HandOver, SweepSession

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
