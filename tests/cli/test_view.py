"""`xrgs-view` from the command line: its address, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
import torch

from xrgs.formats.ply import save_ply
from xrgs.splat.gaussians import Gaussians


@pytest.mark.slow
def test_ctrl_c_ends_it_in_order(tmp_path: Path) -> None:
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    save_ply(tmp_path / "a.ply", Gaussians.from_points(points, points))
    command = [sys.executable, "-P", "-c", "from xrgs.cli.view import main; main()", "a.ply"]
    with subprocess.Popen(
        [*command, "--port", "0", "--limit", "5"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        lines = [process.stdout.readline(), process.stdout.readline()]
        assert lines[0] == "a.ply: the 5 most opaque of 9 Gaussians (--limit 5)\n"
        address = lines[1].split()[1]
        with urllib.request.urlopen(address, timeout=10) as page:  # noqa: S310 - of this machine
            assert b"<iframe" in page.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert "Traceback" not in process.stderr.read()
