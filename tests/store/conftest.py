"""Folders of cells, finished and stopped."""

from pathlib import Path

import pytest

from tests.store.cells import finished
from xrgs.store.cell_folder import CellFolder


@pytest.fixture
def done(tmp_path: Path) -> CellFolder:
    """The folder of a finished cell with two test views."""
    return finished(CellFolder(tmp_path / "cells" / "abc"))


@pytest.fixture
def stopped(done: CellFolder) -> CellFolder:
    """The folder of an attempt that was stopped after a checkpoint, with all that may lie about."""
    done.status_file.unlink()
    done.checkpoint.write_bytes(b"state")
    (done.path / "log.txt").write_text("begun\n")
    (done.path / ".checkpoint.npz.1-abcd").write_bytes(b"half")
    done.progress.write_text("{}")
    return done
