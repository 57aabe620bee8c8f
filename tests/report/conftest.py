"""Stores made by writing files; no cell is trained."""

import json
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

from tests.conftest import composed
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.report.collect import Sweep, read_cells
from xrgs.safeio.atomic import write_json
from xrgs.store.attempts import begin_attempt
from xrgs.store.cell_folder import CellFolder
from xrgs.store.schema import Identity, Provenance, RecordedCell
from xrgs.store.scoring import scoring_code
from xrgs.store.store import Store

SUMMARY = {
    "training_time_s": 100.0,
    "render_time_ms": 8.0,
    "gaussians": 5000,
    "memory_bytes": 2**26,
    "peak_rss_bytes": 2**29,
    "evaluations": 10**9,
    "steps": 500,
}
SCORES = {"psnr": 20.0, "ssim": 0.8, "lpips": 0.25}
VIEWS = ("IMG_001", "IMG_009")
_STEPS = [f"{step},{0.3 / (1 + step)},{100 * step}" for step in range(5)]
HISTORY = "\n".join(["step,loss,gaussians", *_STEPS]) + "\n"
PROVENANCE = Provenance(
    xrgs="0.1.0",
    git=None,
    git_diff_sha256=None,
    python="3.11",
    packages={},
    platform="a platform",
    threads=2,
    backend="torch",
    started="now",
    cpu="a processor",
)


@cache
def baseline_config() -> dict[str, Any]:
    """The baseline's config as it is in a cell's folder."""
    return asdict(composed())


def configured(cell: CellFolder, **changes: dict[str, Any]) -> None:
    """Give a cell the baseline's config with changes by group, and finish it again."""
    config = {
        name: _changed(values, changes.get(name, {})) for name, values in baseline_config().items()
    }
    write_json(cell.path / "config.json", config)
    finish_again(cell)


def _changed(values: Any, changes: dict[str, Any]) -> Any:
    if not changes:
        return values
    return values | {
        name: _changed(values[name], change) if isinstance(change, dict) else change
        for name, change in changes.items()
    }


def finish_again(cell: CellFolder, views: tuple[str, ...] | None = None) -> None:
    """Declare a done cell's files as they are now."""
    status = cell.status()
    cell.finish(views or status.views, status.scored_by)


class MadeStore:
    """A store, and the rows of the sweep that is being written into it."""

    def __init__(self, path: Path) -> None:
        self.store = Store(path)
        self.store.prepare()
        self.rows: list[dict[str, Any]] = []

    def add(
        self,
        label: str = "baseline",
        *,
        scene: str = "fern",
        condition: str = "",
        seed: int = 0,
        draw: int = 0,
        validation: float | None = None,
        train: dict[str, Any] | None = None,
        code: dict[str, str] | None = None,
        factors: dict[str, float] | None = None,
        values: dict[str, Any] | None = None,
        variant: str | None = None,
        scored_by: dict[str, str] | None = None,
        state: str = "done",
        pictures: bool = False,
        cpu: str = "a processor",
        provenance: dict[str, Any] | None = None,
        history: str = HISTORY,
        quality: str | None = None,
        summary: dict[str, Any] | None = None,
    ) -> CellFolder:
        """One cell: the made-up baseline's values times `factors`, or `values` outright.

        `provenance` and `summary` have more entries of its files, `quality` the scores during
        training, `scored_by` digests of other scoring code. `train` and `code` are those of its
        identity.
        """
        cell_id = f"cell{len(self.rows):05d}"
        variant = variant or f"variant-of-{len(scene)}-{scene[:3]}".replace("/", "_")
        found = SUMMARY | SCORES | (values or {})
        found |= {key: found[key] * factor for key, factor in (factors or {}).items()}
        folder = self.store.cell(cell_id)
        train = (train or {}) | ({} if validation is None else {"validation": validation})
        identity = Identity(
            variant=variant, seed=seed, train=train, splat={}, components={}, code=code or {}
        )
        folder.path.mkdir()
        write_json(folder.path / "identity.json", msgspec.to_builtins(identity))
        begin_attempt(folder)
        base = [
            row["cell_id"]
            for row in self.rows
            if (row["label"], row["scene"], row["condition"], row["variant_seed"], row["seed"])
            == ("baseline", scene, condition, draw, seed)
        ]
        self.rows.append(
            {
                "cell_id": cell_id,
                "label": label,
                "condition": condition,
                "scene": scene,
                "variant_seed": draw,
                "seed": seed,
                "variant_id": variant,
                "baseline_id": (base or [cell_id])[0],
                "error": None,
            }
        )
        if state == "failed":
            folder.fail("RuntimeError: out of luck")
            return folder
        self._fill(folder, found | (summary or {}), {"cpu": cpu} | (provenance or {}))
        (folder.path / "history.csv").write_text(history)
        if quality is not None:
            (folder.path / "quality.csv").write_text(quality)
        if pictures:
            split = "train" if validation else "test"
            self._draw(folder, f"{variant}/images/{split}", noise=0.02 * len(self.rows))
        folder.finish(VIEWS, scoring_code() | (scored_by or {}))
        return folder

    def add_error(self, scene: str, label: str = "baseline", seed: int = 0) -> None:
        """A cell of a scene that could not be registered."""
        keys = dict.fromkeys(("cell_id", "variant_id", "baseline_id"))
        self.rows.append(
            keys
            | {"label": label, "condition": "", "scene": scene, "variant_seed": 0, "seed": seed}
            | {"error": f"{scene}: 3 of 24 views registered", "state": "not placed"}
        )

    def write(self, command: tuple[str, ...] = ("+ablation=consistency",)) -> str:
        """Record the sweep; returns its id."""
        return self.store.write_sweep(command, [RecordedCell(**row) for row in self.rows])

    def read(self) -> Sweep:
        """Record the sweep and read it, as a report does."""
        record = self.store.sweep_record(sweep_id := self.write())
        return read_cells(self.store, {sweep_id: record.command}, record.cells)

    @staticmethod
    def _fill(folder: CellFolder, found: dict[str, Any], provenance: dict[str, Any]) -> None:
        names = [*SCORES, *(name for name in VIEW_METRICS if name in found and name not in SCORES)]
        summary = {key: value for key, value in found.items() if key not in names}
        summary |= {key: round(summary[key]) for key in ("gaussians", "steps")}
        (folder.path / "summary.json").write_text(json.dumps(summary))
        made = msgspec.to_builtins(PROVENANCE) | {"started": str(folder.path)} | provenance
        (folder.path / "provenance.json").write_text(json.dumps(made))
        # The views differ, their mean is the value asked for.
        lines = [",".join(["view", *names])]
        for view, offset in zip(VIEWS, (0.05, -0.05), strict=True):
            scores = ["" if found[key] is None else repr(found[key] + offset) for key in names]
            lines.append(",".join([view, *scores]))
        (folder.path / "scores.csv").write_text("\n".join(lines) + "\n")

    def _draw(self, folder: CellFolder, images: str, noise: float) -> None:
        photographs = self.store.path / "variants" / images
        photographs.mkdir(parents=True, exist_ok=True)
        (folder.path / "renders").mkdir()
        for number, view in enumerate(VIEWS):
            rng = np.random.default_rng(number)
            image = np.kron(rng.uniform(0.2, 0.8, (6, 8, 3)), np.ones((10, 10, 1)))
            worse = image.copy()
            worse[20:40, 40:60] += rng.uniform(-1, 1, (20, 20, 3)) * noise
            for path, pixels in (
                (photographs / f"{view}.png", image),
                (folder.path / "renders" / f"{view}.png", worse),
            ):
                Image.fromarray((pixels.clip(0, 1) * 255).astype(np.uint8)).save(path)


@pytest.fixture
def made(tmp_path: Path) -> MadeStore:
    return MadeStore(tmp_path / "store")
