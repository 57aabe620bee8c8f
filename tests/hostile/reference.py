"""A small finished store, and functions that change its files and keep their hashes right.

The store has the variant and the four cells of `xrgs-sweep +ablation=consistency scene=motorcycle
preset=smoke seed=0,1`, under the ids that this command gives them, so that a plan finds them done.
Nothing is trained: the pictures and numbers are made up.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from xrgs import composing
from xrgs.capture import variant
from xrgs.config import Conf
from xrgs.evaluation.protocol import PROTOCOL_VERSION
from xrgs.experiment import provenance
from xrgs.experiment.attempts import begin_attempt
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import Store
from xrgs.safeio.hashing import digest

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


def build(path: Path) -> None:
    """Write the store."""
    store = Store(path)
    store.prepare()
    confs = {(label, seed): _conf(label, seed) for seed in SEEDS for label in LABELS}
    variant_id = _write_variant(path / "variants", confs["baseline", 0])
    made_with = provenance.collect(1, "native")
    ids = {names: _write_cell(store, conf, variant_id, made_with) for names, conf in confs.items()}
    rows = [
        {
            "cell_id": ids[label, seed],
            "label": label,
            "condition": "",
            "scene": "motorcycle",
            "seed": seed,
            "variant_id": variant_id,
            "baseline_id": ids["baseline", seed],
            "error": None,
        }
        for label, seed in confs
    ]
    store.write_sweep(SWEEP, rows)


def _conf(label: str, seed: int) -> Conf:
    ablation = () if label == "baseline" else (f"+ablation={label}",)
    return composing.compose(*ablation, "scene=motorcycle", "preset=smoke", f"seed={seed}")


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
    np.savez(folder / "points.npz", points=points, colors=rng.integers(0, 255, (50, 3), np.uint8))
    report = {"registered": 5, "images": 5, "points": 50, "hr": ["left"], "lr": ["right"]}
    (folder / "report.json").write_text(json.dumps(report))
    files = ["points.npz", *(str(view["file"]) for view in views)]
    content = {
        "key": key,
        "scene": "motorcycle",
        "factor": 2,
        "held_out": True,
        "views": sorted(views, key=lambda view: (view["split"], view["name"])),
        "files": dict.fromkeys(files, ""),
    }
    (folder / "variant.json").write_text(json.dumps(content))
    return seal_variant(folder).name


#: The totals of a cell's steps.
_WORK = {
    "views": 3,
    "gaussians": 1200,
    "gaussians_visible": 1000,
    "pixels": 9000,
    "pixels_photograph": 10_000,
    "pixels_left_out": 1000,
    "pairs": 10**8,
    "pairs_visible": 10**7,
    "pairs_in_tiles": 2 * 10**6,
    "sh_coefficients": 16_000,
    "sh_coefficients_left_out": 4000,
}


def _write_cell(store: Store, conf: Conf, variant_id: str, made_with: dict[str, Any]) -> str:
    identity = cell_identity(conf, variant_id)
    cell = store.cell(digest(identity))
    begin_attempt(cell, asdict(conf), identity)
    (cell.path / "provenance.json").write_text(json.dumps(made_with))
    rng = np.random.default_rng(conf.seed)
    vertices = rng.normal(size=(20, len(_PLY_COLUMNS))).astype("<f4")
    (cell.path / "splats.ply").write_bytes(ply(vertices))
    steps = [f"{step},left,{0.3 / (1 + step)},{20 + step},{step},0,0" for step in range(0, 60, 6)]
    columns = "step,view,loss,gaussians,steps_HR,steps_LR,split"
    (cell.path / "history.csv").write_text("\n".join([columns, *steps]) + "\n")
    scores = [f"{view},{20.5 + conf.seed},0.8,0.25" for view in TESTS]
    (cell.path / "scores.csv").write_text("\n".join(["view,psnr,ssim,lpips", *scores]) + "\n")
    summary: dict[str, Any] = {
        "training_time_s": 9.5,
        "gaussians": 20,
        "memory_bytes": 2**20,
        "steps": 60,
    }
    summary |= {"peak_rss_bytes": 2**28, "evaluations": 10**6, "grow_grad2d": 0.0002}
    summary |= {"work": _WORK, "stage_seconds": {"forward": 5, "backward": 3, "optimizer": 1}}
    (cell.path / "summary.json").write_text(json.dumps(summary))
    quality = [f"{step},{step},{9000 * step},20,0.5,0.7,{step / 4}" for step in range(10, 60, 10)]
    columns = "step,seconds,evaluations,gaussians,lpips,ssim,psnr"
    (cell.path / "quality.csv").write_text("\n".join([columns, *quality]) + "\n")
    (cell.path / "log.txt").write_text("a line of the log\n")
    (cell.path / "renders").mkdir()
    for number, view in enumerate(TESTS):
        render = picture(10 * conf.seed + number, WIDTH, HEIGHT)
        render.save(cell.path / "renders" / f"{view}.png")
    cell.finish(TESTS, PROTOCOL_VERSION)
    return cell.id


def ply(vertices: np.ndarray[Any, np.dtype[np.float32]], count: object = None) -> bytes:
    """A .ply of Gaussians of degree 0, whose header may declare another number of vertices."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"element vertex {len(vertices) if count is None else count}"]
    lines += [f"property float {name}" for name in _PLY_COLUMNS]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + vertices.tobytes()


# --- the parts of a store -----------------------------------------------------------------------


def sweep_file(store: Path) -> Path:
    """The record of the sweep."""
    return next((store / "sweeps").glob("*.json"))


def cell_of(store: Path, label: str = "consistency", seed: int = 1) -> Path:
    """The folder of a cell. The default is of the second pair: the first one stays healthy."""
    rows = json.loads(sweep_file(store).read_text())["cells"]
    (name,) = (row["cell_id"] for row in rows if (row["label"], row["seed"]) == (label, seed))
    return store / "cells" / str(name)


def all_cells(store: Path) -> list[Path]:
    """The folders of all cells."""
    return sorted((store / "cells").iterdir())


def variant_of(store: Path) -> Path:
    """The folder of the variant."""
    return next((store / "variants").glob("[0-9a-f]*-*"))


# --- changes ------------------------------------------------------------------------------------


def edit(file: Path, change: Callable[[Any], object]) -> None:
    """Change the JSON value in a file in place."""
    value = json.loads(file.read_text())
    change(value)
    file.write_text(json.dumps(value))


def seal(cell: Path) -> None:
    """Let the cell's status list the files as they are now."""
    status = json.loads((cell / "status.json").read_text())
    for name in status["files"]:
        file = cell / name
        if file.is_file() and not file.is_symlink():
            status["files"][name] = {"bytes": file.stat().st_size, "sha256": _sha256(file)}
    (cell / "status.json").write_text(json.dumps(status))


def seal_variant(folder: Path, *, hash_files: bool = True) -> Path:
    """Let the variant list its files as they are now, and return the folder under its new id.

    The id is the key and a hash of all of `variant.json` but the id and the scene.
    """
    content = json.loads((folder / "variant.json").read_text())
    for name in content["files"] if hash_files else ():
        if (folder / name).is_file():
            content["files"][name] = _sha256(folder / name)
    hashed = {key: value for key, value in content.items() if key not in {"id", "scene"}}
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    content["id"] = f"{content['key']}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    (folder / "variant.json").write_text(json.dumps(content))
    return folder.rename(folder.with_name(content["id"]))


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def replace_column(file: Path, value: str, columns: Iterable[int]) -> None:
    """Write a value into some columns of each row of a CSV table below the header."""
    header, *rows = file.read_text().splitlines()
    changed = [
        ",".join(value if number in columns else old for number, old in enumerate(row.split(",")))
        for row in rows
    ]
    file.write_text("\n".join([header, *changed]) + "\n")
