"""Measures what each approximation costs in PSNR: a cell is trained again with it changed.

The shortcuts of `xrgs.bench.shortcuts` are not measured here: they change no bit, or only the
rounding at a cutoff, as their table says for each.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch

from xrgs import composing
from xrgs.bench.loads import load_cell_dataset
from xrgs.evaluation import metrics
from xrgs.safeio.records import read_json
from xrgs.splat.backend import resolve_backend
from xrgs.splat.rendering import rasterize_parameters
from xrgs.training.count_matching import train_cell

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from xrgs.capture.dataset import LoadedView
    from xrgs.config import Conf
    from xrgs.training.recorder import TrainingResult

UNCHANGED = "unchanged"


def compare(folder: Path, steps: int) -> list[dict[str, Any]]:
    """Train a cell's variant with its config, and again with each approximation changed.

    Args:
        folder: Folder of a finished cell in its store; nothing is written there.
        steps: Number of training steps; every schedule scales with it.

    Returns:
        A row for each run: `change`; `psnr`, the mean of the test views in dB; `difference`, from
        the unchanged run's (that of another seed shows how much is chance); `gaussians`,
        `evaluations` (of alpha) and `seconds`.

    Raises:
        XrgsError: The cell isn't done, or its variant isn't in the store.
    """
    data = load_cell_dataset(folder)
    conf = composing.from_dict(read_json(folder / "config.json"))
    conf.train.steps = steps
    rows: list[dict[str, Any]] = []
    for name, changed in _changes(conf).items():
        trained = train_cell(data, changed)
        psnr = _psnr(trained, data.test, changed)
        rows.append(
            {
                "change": name,
                "steps": steps,
                "psnr": psnr,
                "difference": psnr - rows[0]["psnr"] if rows else 0.0,
                "gaussians": len(trained.gaussians),
                "evaluations": trained.evaluations,
                "seconds": trained.seconds,
            }
        )
    return rows


def _changes(conf: Conf) -> dict[str, Conf]:
    """Return copies of a cell's config by name, each but the first with one value changed."""
    names = [UNCHANGED, "another seed", "alpha cut 4/255", "alpha cut 1/1020", "stop at 1e-2"]
    consistency = conf.components.consistency
    modes = [mode for mode in ("exact", "fold", "off") if mode != consistency.lr_mode]
    if consistency.weight != 0:
        names += [f"LR consistency {mode}" for mode in modes]
    configs = {name: composing.from_dict(asdict(conf)) for name in names}
    configs["another seed"].seed += 1
    configs["alpha cut 4/255"].splat.raster.alpha_min = 4 / 255
    configs["alpha cut 1/1020"].splat.raster.alpha_min = 1 / 1020
    configs["stop at 1e-2"].splat.raster.transmittance_min = 1e-2
    for mode in modes:
        if (name := f"LR consistency {mode}") in configs:
            configs[name].components.consistency.lr_mode = mode
    return configs


def _psnr(trained: TrainingResult, views: Sequence[LoadedView], conf: Conf) -> float:
    backend, raster = resolve_backend(conf.splat.backend), conf.splat.raster
    values = []
    with torch.no_grad():
        for view in views:
            render = rasterize_parameters(
                *trained.gaussians.activated(backend=backend),
                view.camera,
                raster,
                sh_degree=raster.sh_degree,
                backend=backend,
            )
            values.append(metrics.psnr(render.image.clamp(0.0, 1.0), view.image))
    return sum(values) / len(values)
