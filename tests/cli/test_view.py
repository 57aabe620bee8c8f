"""`xrgs-view` from the command line: its address, and how it ends."""

from __future__ import annotations

import signal
import urllib.request
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from xrgs.cli import view
from xrgs.formats.ply import save_ply
from xrgs.runtime.signals import StopSignal
from xrgs.splat.gaussians import Gaussians


@pytest.mark.slow
def test_ctrl_c_ends_it_in_order(
    call_command: Callable[..., tuple[int, str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In place of waiting, the page is read, and then comes the signal."""
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    save_ply(tmp_path / "a.ply", Gaussians.from_points(points, points))

    def wait() -> None:
        first, second = capsys.readouterr().out.splitlines()[-2:]
        assert first == "a.ply: the 5 most opaque of 9 Gaussians (--limit 5)"
        with urllib.request.urlopen(second.split()[1], timeout=10) as page:  # noqa: S310 - local
            assert b"<iframe" in page.read()
        raise StopSignal(signal.SIGINT)

    events = SimpleNamespace(Event=lambda: SimpleNamespace(wait=wait))
    monkeypatch.setattr(view, "threading", events)
    try:
        code, out, err = call_command("view", "a.ply", "--port", "0", "--limit", "5")
    except StopSignal:  # which would end all tests
        pytest.fail("nobody has handled the signal")
    assert (code, out) == (0, ""), err
    assert "Traceback" not in err
