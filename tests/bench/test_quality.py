from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from xrgs.bench import quality, tables
from xrgs.capture.dataset import Dataset, LoadedView
from xrgs.config import Conf
from xrgs.safeio.atomic import write_json
from xrgs.splat.cameras import Camera


@pytest.fixture
def cell(tmp_path: Path, baseline: Conf, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cell's config, and two small views in place of its variant's."""
    baseline.components.consistency.weight = 0.5
    write_json(tmp_path / "config.json", asdict(baseline))
    generator = torch.Generator().manual_seed(0)
    views = []
    for tag, side in (("HR", 55), ("LR", 11)):
        K = torch.tensor([[1.2 * side, 0, side / 2], [0, 1.2 * side, side / 2], [0, 0, 1]])
        ramp = torch.linspace(0, 1, side).expand(side, side)
        image = torch.stack([ramp, ramp.T, ramp.flip(1)], dim=-1)
        views.append(LoadedView(tag, tag, Camera(torch.eye(4), K, side, side), image))
    points = torch.rand(40, 3, generator=generator) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
    colors = torch.rand(40, 3, generator=generator)
    data = Dataset(tuple(views), tuple(views[:1]), points, colors, scene_scale=1.0, factor=5)
    monkeypatch.setattr(quality, "load_cell_dataset", lambda _: data)
    return tmp_path


def test_each_cut_is_trained_and_compared(cell: Path) -> None:
    rows = {row["change"]: row for row in quality.compare(cell, steps=6)}
    assert next(iter(rows)) == quality.UNCHANGED
    assert {"LR consistency fold", "LR consistency off"} < set(rows)
    assert "LR consistency exact" not in rows  # as it is
    assert rows[quality.UNCHANGED]["difference"] == 0
    for name in ("another seed", "alpha cut 4/255", "LR consistency off"):
        assert rows[name]["psnr"] != rows[quality.UNCHANGED]["psnr"]
        change = rows[name]["psnr"] - rows[quality.UNCHANGED]["psnr"]
        assert rows[name]["difference"] == pytest.approx(change)
    fewer, usual = rows["alpha cut 4/255"], rows[quality.UNCHANGED]
    assert fewer["evaluations"] < usual["evaluations"]
    assert "stop at 1e-2" in tables.quality(list(rows.values()))
