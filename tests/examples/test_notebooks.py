"""The notebooks of `examples/` run from first to last cell, and are kept without outputs."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient
from PIL import Image

from xrgs import load_gaussians
from xrgs.photos.scenes import procedural, still_life

EXAMPLES = Path(__file__).parents[2] / "examples"
SIZE = (320, 240)


def read(name: str) -> Any:
    return nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)  # type: ignore[no-untyped-call]


def run(notebook: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], int]:
    """Run a notebook; return its printed outputs and values as text, and how many images it has."""
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    commands = Path(sys.executable).parent  # of this environment, active or not
    monkeypatch.setenv("PATH", f"{commands}{os.pathsep}{os.environ['PATH']}")
    resources = {"metadata": {"path": folder}}
    NotebookClient(notebook, timeout=900, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    data = [output.get("data", {}) for output in outputs]
    texts = [
        output.get("text", "") or of.get("text/plain", "")
        for output, of in zip(outputs, data, strict=True)
    ]
    return texts, sum("image/png" in of for of in data)


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda file: file.stem)
def test_a_notebook_is_kept_without_outputs(file: Path) -> None:
    cells = [cell for cell in read(file.stem).cells if cell.cell_type == "code"]
    assert cells
    assert not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_photographs_of_two_sizes_are_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the line for a folder of one's own in place of the embedded scene."""
    garden = tmp_path / "garden"
    garden.mkdir()
    cameras = dict(zip(procedural.names(12), procedural.viewmats(12), strict=True))
    intrinsics = procedural.intrinsics(*SIZE)
    still_life.render(garden, procedural.TEXTURES, intrinsics, SIZE, cameras)
    for index, file in enumerate(sorted(garden.iterdir())):
        with Image.open(file) as image:  # saved as JPEG: PNGs of xrgs are no photographs
            half = image.resize((SIZE[0] // 2, SIZE[1] // 2))
            (half if index % 2 else image).save(file.with_suffix(".jpg"), quality=95)
        file.unlink()
    notebook = read("train_photographs")
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    first.source, lines = re.subn(r"^# (scene = )", r"\1", first.source, flags=re.MULTILINE)
    assert lines == 1

    texts, images = run(notebook, tmp_path, monkeypatch)

    (views,) = (text for text in texts if "width" in text)
    kinds = {tuple(row.split()[-3:]) for row in views.splitlines()[1:]}
    large = {("HR", "160", "120"), ("LR", "160", "120")}  # by their distance
    assert kinds - large == {("LR", "80", "60")}
    assert ("HR", "160", "120") in kinds
    assert images == 2
    gaussians, antialiased = load_gaussians(tmp_path / "scene.ply")
    assert texts[-1] == f"{len(gaussians)} Gaussians, antialiased=True\n"
    assert antialiased


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_two_recipes_are_compared_and_filmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts, _ = run(read("compare_recipes"), tmp_path, monkeypatch)
    scores, changes = (text for text in texts if text.lstrip().startswith(("psnr", "label")))
    assert {row.split()[0] for row in scores.splitlines()[2:]} == {"baseline", "lean", "plus"}
    assert changes.split()[1:3] == ["lean", "plus"]
    assert (tmp_path / "film.mp4").stat().st_size > 1000
