"""A cell's own part of the way: what it hands from room to room."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from xrgs import cell, dataset
from xrgs.config import Conf
from xrgs.store import CellFolder


class LoadError(Exception):
    """Which views a cell asked for; it goes no further."""


@pytest.mark.parametrize("ablation", ["baseline", *dataset.USES[1:]])
def test_the_controls_choose_the_views_that_are_trained_on(
    ablation: str, compose: Callable[..., Conf], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(variant: object, use: str) -> None:
        del variant
        raise LoadError(use)

    monkeypatch.setattr(dataset, "load", load)
    views = "mixed" if ablation == "baseline" else ablation
    with pytest.raises(LoadError, match=views):
        cell.run(compose(f"+ablation={ablation}"), SimpleNamespace(), CellFolder(tmp_path))
