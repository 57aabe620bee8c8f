"""What a skip that changes numbers does to the pictures: a cell trained again, with and without.

Only such skips are here. The renderer's (`xrgs.splat.settings.CullingOptions`) and those of
`xrgs.bench.skips` change no bit, or rounding at a cut, as the tables there say of each.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch

from xrgs import config
from xrgs.bench.loads import data_of
from xrgs.evaluation import metrics
from xrgs.safeio.records import read_json
from xrgs.splat.backend import resolve_backend
from xrgs.splat.rasterize import rasterize
from xrgs.training.count_matching import train_cell

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from xrgs.capture.dataset import LoadedView
    from xrgs.config import Conf
    from xrgs.training.recorder import TrainingResult

AS_IT_IS = "as it is"


def compare(folder: Path, steps: int) -> list[dict[str, Any]]:
    """Train a cell's variant with its config, and again with each cut changed.

    Args:
        folder: Of a finished cell, in its store; nothing is written there.
        steps: To train for; every schedule scales with them.

    Returns:
        A row each: `change`, mean `psnr` of the test views in dB, its `difference` from the cell as
        it is (what another seed changes says how much of that is chance), Gaussians, alpha
        evaluations and seconds.

    Raises:
        XrgsError: the cell isn't done, or its variant isn't in the store.
    """
    data = data_of(folder)
    conf = config.from_dict(read_json(folder / "config.json"))
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
    """Copies of a cell's config, each but the first with one thing changed."""
    names = [AS_IT_IS, "another seed", "alpha cut 4/255", "alpha cut 1/1020", "stop at 1e-2"]
    consistency = conf.components.consistency
    modes = [mode for mode in ("exact", "fold", "off") if mode != consistency.lr_mode]
    if consistency.weight != 0:
        names += [f"LR consistency {mode}" for mode in modes]
    made = {name: config.from_dict(asdict(conf)) for name in names}
    made["another seed"].seed += 1
    made["alpha cut 4/255"].splat.raster.alpha_min = 4 / 255
    made["alpha cut 1/1020"].splat.raster.alpha_min = 1 / 1020
    made["stop at 1e-2"].splat.raster.transmittance_min = 1e-2
    for mode in modes:
        if (name := f"LR consistency {mode}") in made:
            made[name].components.consistency.lr_mode = mode
    return made


def _psnr(trained: TrainingResult, views: Sequence[LoadedView], conf: Conf) -> float:
    backend, raster = resolve_backend(conf.splat.backend), conf.splat.raster
    values = []
    with torch.no_grad():
        for view in views:
            render = rasterize(
                *trained.gaussians.activated(),
                view.camera,
                raster,
                sh_degree=raster.sh_degree,
                backend=backend,
            )
            values.append(metrics.psnr(render.image.clamp(0.0, 1.0), view.image))
    return sum(values) / len(values)
