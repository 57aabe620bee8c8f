"""The numbers of reports/ are what its cells say: reports are made again from packed stores."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pandas as pd
import pytest

from xrgs.experiment.store import Store
from xrgs.report.page import build

REPORTS = Path(__file__).parents[2] / "reports"
PACKED = sorted(REPORTS.glob("*/store.tar.xz"))
#: Files of a report that no photograph has a part in, which a packed store does not have.
FILES = (
    "cells.csv",
    "curves.csv",
    "provenance.json",
    "skipped.csv",
    "table.csv",
    "table.tex",
    "time_to_quality.csv",
    "training.csv",
)


@pytest.mark.slow
@pytest.mark.parametrize("packed", PACKED, ids=lambda path: path.parent.name)
def test_a_packed_store_gives_the_committed_tables(packed: Path, tmp_path: Path) -> None:
    with tarfile.open(packed) as archive:
        archive.extractall(tmp_path, filter="data")
    store = Store(tmp_path / "xrgs-store")
    made = build(store.path, store.sweep_ids(), tmp_path / "report", pictures=[])
    for name in FILES:
        now, committed = made.folder / name, packed.parent / name
        if name.endswith(".csv"):
            # numpy's log and exp differ in their last digit between instruction sets.
            pd.testing.assert_frame_equal(
                pd.read_csv(now), pd.read_csv(committed), rtol=1e-13, atol=0
            )
        else:
            assert now.read_text(encoding="utf-8") == committed.read_text(encoding="utf-8"), name


def test_there_are_packed_stores() -> None:
    assert PACKED
