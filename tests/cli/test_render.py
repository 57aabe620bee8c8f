"""`xrgs-render` from the command line, on cells of a real sweep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import xrgs
from xrgs.store.store import Store

RunCommand = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
def test_a_frame_at_the_first_test_view_is_the_render_that_was_scored(
    call_command: RunCommand, store: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The two views of this scene differ in intrinsics; a film has those of the first."""
    cells = Store(store).cells(verify=False).set_index("label")["cell_id"]
    for label, cell_id in cells.items():
        renders = sorted((store / "cells" / cell_id / "renders").iterdir())
        code, out, err = call_command(
            *("render", cell_id[:10], "--store", "s", "--path", "test"),
            *("--views", str(len(renders)), "--out", str(label)),
        )
        assert code == 0, err
        assert out.startswith(f"{label}: {len(renders)} frames of ")
        frames = sorted((store.parent / str(label)).iterdir())
        assert len(frames) == len(renders)
        found, expected = (np.asarray(Image.open(f[0])).astype(int) for f in (frames, renders))
        height, width = found.shape[:2]
        assert np.abs(found - expected[:height, :width]).max() <= 1
        assert (found == expected[:height, :width]).mean() > 0.999
    both = ("--store", "s", "--views", "3", "--size", "64", "48", "--out", "both.mp4")
    code, out, err = call_command("render", *cells, *both)
    assert code == 0, err
    assert out == "both.mp4: 3 frames of 128 x 48 px, 0.1 s, path orbit\n"
    gaussians = Store(store).cell(cell_id).gaussians()
    # Small and opaque ones, which the filter makes fainter.
    gaussians.scales = torch.full_like(gaussians.scales, -6)
    gaussians.opacities = torch.full_like(gaussians.opacities, 3)
    xrgs.save_gaussians(store.parent / "small.glb", gaussians, antialiased=True)
    pairs = []
    for asked in ((), ("--antialiased", "no")):
        out = f"pair{len(asked)}"
        pair = (cell_id, "small.glb", "--path", "test", "--views", "1", "--out", out)
        code, _, err = call_command("render", *pair, "--store", "s", *asked)
        assert code == 0, err
        said = "small.glb is antialiased; it is rendered without antialiasing, as asked"
        assert (said in caplog.text) == bool(asked)
        (frame,) = (store.parent / out).iterdir()
        pairs.append(np.asarray(Image.open(frame)).astype(int))
    own, other = np.split(np.abs(pairs[0] - pairs[1]), 2, axis=1)
    assert own.max() == 0
    assert other.max() > 3
