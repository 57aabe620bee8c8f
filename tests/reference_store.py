"""A small finished store.

The store has the variant and the four cells of `xrgs-sweep +ablation=consistency scene=motorcycle
preset=smoke seed=0,1`, under the ids that this command gives them, so that a plan finds them done.
Nothing is trained: the pictures and numbers are made up.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from PIL import Image

from tests.conftest import composed
from xrgs.config import Conf
from xrgs.mixture import saved_variant, variant
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json
from xrgs.store import provenance
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.identity import cell_id, cell_identity
from xrgs.store.schema import Provenance, RecordedCell, Summary
from xrgs.store.scoring import scoring_code
from xrgs.store.store import Store

LABELS = ("baseline", "consistency")
SEEDS = (0, 1)
SWEEP = ("+ablation=consistency", "scene=motorcycle", "preset=smoke", "seed=0,1")
WIDTH, HEIGHT = 40, 30
TESTS = ("view_1", "view_2")
_TRAINED = (("left", "HR", 1), ("middle", "HR", 1), ("right", "LR", 2))
_PLY_COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
#: The totals of a cell's steps.
_WORK = {
    "views": 3.0,
    "gaussians": 1200.0,
    "gaussians_visible": 1000.0,
    "pixels": 9000.0,
    "pixels_photograph": 10_000.0,
    "pixels_left_out": 1000.0,
    "pairs": 1e8,
    "pairs_visible": 1e7,
    "pairs_in_tiles": 2e6,
    "sh_coefficients": 16_000.0,
    "sh_coefficients_left_out": 4000.0,
}
_SUMMARY = Summary(
    training_time_s=9.5,
    render_time_ms=3.0,
    gaussians=20,
    memory_bytes=2.0**20,
    evaluations=1e6,
    steps=60,
    peak_rss_bytes=2.0**28,
    grow_grad2d=0.0002,
    work=_WORK,
    stage_seconds={"forward": 5.0, "backward": 3.0, "optimizer": 1.0},
)


def build(path: Path) -> None:
    """Write the store."""
    store = Store(path)
    store.prepare()
    confs = {(label, seed): _conf(label, seed) for seed in SEEDS for label in LABELS}
    variant_id = _write_variant(path / "variants", confs["baseline", 0])
    made_with = provenance.collect(1, "native")
    ids = {names: _write_cell(store, conf, variant_id, made_with) for names, conf in confs.items()}
    rows = [
        RecordedCell(
            cell_id=ids[label, seed],
            label=label,
            condition="",
            scene="motorcycle",
            variant_seed=0,
            seed=seed,
            variant_id=variant_id,
            baseline_id=ids["baseline", seed],
        )
        for label, seed in confs
    ]
    store.write_sweep(SWEEP, rows)


def _conf(label: str, seed: int) -> Conf:
    ablation = () if label == "baseline" else (f"+ablation={label}",)
    return composed(*ablation, "scene=motorcycle", "preset=smoke", f"seed={seed}")


def picture(seed: int, width: int, height: int) -> Image.Image:
    """A ramp with noise."""
    ramp = np.linspace(40, 200, width)[None, :, None] * np.ones((height, 1, 3))
    noise = np.random.default_rng(seed).integers(0, 50, (height, width, 3))
    return Image.fromarray((ramp + noise).astype(np.uint8))


def _write_variant(variants: Path, conf: Conf) -> str:
    key = variant.key(conf.scene, conf.variant)
    folder = variants / "unnamed"
    views = []
    shown = [("train", *trained) for trained in _TRAINED]
    shown += [("test", name, "HR", 1) for name in TESTS]
    for number, (split, name, tag, factor) in enumerate(shown):
        width, height = WIDTH // factor, HEIGHT // factor
        file = folder / "images" / split / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        picture(number, width, height).save(file)
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.1 * number
        views.append(
            {
                "name": name,
                "file": file.relative_to(folder).as_posix(),
                "split": split,
                "tag": tag,
                "width": width,
                "height": height,
                "K": [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]],
                "viewmat": viewmat.tolist(),
                "rho": 1 / factor,
            }
        )
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.5, -0.5, 2.5), (0.5, 0.5, 3.5), (50, 3))
    np.savez(
        folder / saved_variant.POINTS, points=points, colors=rng.integers(0, 255, (50, 3), np.uint8)
    )
    report = {"registered": 5, "images": 5, "points": 50, "hr": ["left"], "lr": ["right"]}
    (folder / saved_variant.REPORT).write_text(json.dumps(report))
    content = {
        "key": key,
        "scene": "motorcycle",
        "factor": 2,
        "held_out": True,
        "views": sorted(views, key=lambda view: (view["split"], view["name"])),
        "files": checksums.hashes(
            folder, [saved_variant.POINTS, *(str(view["file"]) for view in views)]
        ),
    }
    manifest = msgspec.convert(content, saved_variant.Manifest)
    manifest = msgspec.structs.replace(manifest, id=manifest.computed_id())
    write_json(folder / saved_variant.MANIFEST, msgspec.to_builtins(manifest))
    return folder.rename(variants / manifest.id).name


def _write_cell(store: Store, conf: Conf, variant_id: str, made_with: Provenance) -> str:
    identity = cell_identity(conf, variant_id)
    cell = store.cell(cell_id(identity))
    plan_cell(cell, conf, identity)
    begin_attempt(cell)
    write_json(cell.path / "provenance.json", msgspec.to_builtins(made_with))
    write_json(cell.path / "summary.json", msgspec.to_builtins(_SUMMARY))
    rng = np.random.default_rng(conf.seed)
    vertices = rng.normal(size=(20, len(_PLY_COLUMNS))).astype("<f4")
    (cell.path / "splats.ply").write_bytes(ply(vertices))
    steps = [f"{step},left,{0.3 / (1 + step)},{20 + step},{step},0,0" for step in range(0, 60, 6)]
    columns = "step,view,loss,gaussians,steps_HR,steps_LR,split"
    (cell.path / "history.csv").write_text("\n".join([columns, *steps]) + "\n")
    scores = [f"{view},{20.5 + conf.seed},0.8,0.25" for view in TESTS]
    (cell.path / "scores.csv").write_text("\n".join(["view,psnr,ssim,lpips", *scores]) + "\n")
    quality = [f"{step},{step},{9000 * step},20,0.5,0.7,{step / 4}" for step in range(10, 60, 10)]
    columns = "step,seconds,evaluations,gaussians,lpips,ssim,psnr"
    (cell.path / "quality.csv").write_text("\n".join([columns, *quality]) + "\n")
    (cell.path / "log.txt").write_text("a line of the log\n")
    (cell.path / "renders").mkdir()
    for number, view in enumerate(TESTS):
        render = picture(10 * conf.seed + number, WIDTH, HEIGHT)
        render.save(cell.path / "renders" / f"{view}.png")
    cell.finish(TESTS, scoring_code())
    return cell.id


def ply(vertices: np.ndarray[Any, np.dtype[np.float32]]) -> bytes:
    """A .ply of Gaussians of degree 0."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {name}" for name in _PLY_COLUMNS]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + vertices.tobytes()
