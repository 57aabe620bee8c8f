"""Makes the folders of cells without training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from tests.conftest import composed
from xrgs.mixture import saved_variant
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json
from xrgs.store.attempts import begin_attempt, plan_cell
from xrgs.store.schema import Identity, Provenance, RecordedCell, Summary

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.config import Conf
    from xrgs.store.cell_folder import CellFolder

SUMMARY = Summary(1.5, 2.0, 7, 1e6, 1e4, steps=10)
PROVENANCE = Provenance(
    xrgs="0.2.0",
    git=None,
    git_diff_sha256=None,
    python="3.12.0",
    packages={"torch": "2.13.0"},
    platform="Linux",
    threads=1,
    backend="torch",
    started="2026-01-01T00:00:00+00:00",
)
SCORES = "view,psnr,ssim,lpips\na,20.5,0.75,\nb,30.0,0.5,0.25\n"


def identity(seed: int = 0, variant: str = "key-hash") -> Identity:
    """The identity of a cell that is never trained."""
    return Identity(variant, seed, {"views": "mixed"}, {"backend": "torch"}, {})


def row(
    cell_id: str | None, label: str = "baseline", *, scene: str = "fern", seed: int = 0
) -> RecordedCell:
    """A cell in the record of a sweep."""
    return RecordedCell(cell_id, label, "", scene, 0, seed, "key-hash", None)


def write_variant(variants: Path, key: str = "0123456789abcdef") -> str:
    """Write a frozen variant of two views without photographs; return its id."""
    folder = variants / "new"
    (folder / "images").mkdir(parents=True)
    eye = [[1.0 * (row == column) for column in range(4)] for row in range(4)]
    views = []
    for split, name in (("train", "a"), ("test", "b")):
        file = folder / "images" / split / f"{name}.png"
        file.parent.mkdir()
        file.write_bytes(b"image")
        view: dict[str, object] = {
            "name": name,
            "split": split,
            "file": f"images/{split}/{name}.png",
            "tag": "HR",
        }
        view |= {"width": 2, "height": 2, "K": [line[:3] for line in eye[:3]], "viewmat": eye}
        views.append(view | {"rho": 1.0})
    np.savez(
        folder / saved_variant.POINTS, points=np.ones((4, 3)), colors=np.zeros((4, 3), np.uint8)
    )
    write_json(folder / saved_variant.REPORT, {"registered": 2})
    content = {"key": key, "scene": "fern", "factor": 4, "held_out": False, "views": views}
    files = [saved_variant.POINTS, *(str(view["file"]) for view in views)]
    content["files"] = checksums.hashes(folder, files)
    manifest = msgspec.convert(content, saved_variant.Manifest)
    manifest = msgspec.structs.replace(manifest, id=manifest.computed_id())
    write_json(folder / saved_variant.MANIFEST, msgspec.to_builtins(manifest))
    folder.rename(variants / manifest.id)
    return manifest.id


def begun(cell: CellFolder, conf: Conf | None = None, what: Identity | None = None) -> CellFolder:
    """Begin an attempt at a cell, as a sweep does."""
    cell.path.parent.mkdir(parents=True, exist_ok=True)
    plan_cell(cell, conf or composed("scene=motorcycle"), what or identity())
    assert begin_attempt(cell)
    return cell


def finished(
    cell: CellFolder, conf: Conf | None = None, what: Identity | None = None
) -> CellFolder:
    """Begin a cell, and write every file of a done one."""
    begun(cell, conf, what)
    write_json(cell.path / "summary.json", msgspec.to_builtins(SUMMARY))
    write_json(cell.path / "provenance.json", msgspec.to_builtins(PROVENANCE))
    (cell.path / "scores.csv").write_text(SCORES)
    (cell.path / "history.csv").write_text("step,view,gaussians,loss\n0,c,7,0.5\n")
    (cell.path / "splats.ply").write_bytes(b"20 Gaussians")
    (cell.path / "renders").mkdir()
    for view in ("a", "b"):
        (cell.path / "renders" / f"{view}.png").write_bytes(b"1234")
    cell.finish(["a", "b"], {"psnr": "0123"})
    return cell
