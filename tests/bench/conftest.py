from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.bench import loads


@pytest.fixture
def load() -> loads.Load:
    """A small random load."""
    return loads.random_load(150, 40, 30, seed=0)


@pytest.fixture
def file(load: loads.Load, tmp_path: Path) -> Path:
    """The load in a .npz."""
    path = tmp_path / "load.npz"
    loads.write(path, load)
    return path
