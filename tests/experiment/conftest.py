"""Folders of cells, finished and stopped."""

from pathlib import Path

import pytest

from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.cell_folder import CellFolder
from xrgs.safeio.atomic import write_json


@pytest.fixture
def done(tmp_path: Path) -> CellFolder:
    """The folder of a finished cell with two test views."""
    (tmp_path / "cells").mkdir()
    folder = CellFolder(tmp_path / "cells" / "abc")
    begin_attempt(folder, {"seed": 0}, {"seed": 0})
    (folder.path / "scores.csv").write_text("view,psnr,ssim,lpips\na,20.5,0.75,\nb,30.0,0.5,\n")
    (folder.path / "history.csv").write_text("step,loss\n0,0.5\n")
    write_json(folder.path / "summary.json", {"gaussians": 7})
    (folder.path / "renders").mkdir()
    (folder.path / "renders" / "a.png").write_bytes(b"1234")
    folder.finish(["a", "b"], protocol=1)
    return folder


@pytest.fixture
def stopped(done: CellFolder) -> CellFolder:
    """A folder of a try that was stopped after a checkpoint, with all that may lie about."""
    (done.path / "status.json").unlink()
    done.checkpoint.path.write_bytes(b"state")
    (done.path / "log.txt").write_text("begun\n")
    (done.path / ".checkpoint.npz.1-abcd").write_bytes(b"half")
    done.progress.path.write_text("{}")
    return done
