"""The notebooks of `examples/` run from first to last cell, and are kept without outputs.

One is run by Jupyter; the other, which has no shell command, in this process.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest
from PIL import Image

from xrgs import load_gaussians
from xrgs.photos.scenes import procedural, still_life

EXAMPLES = Path(__file__).parents[2] / "examples"
SIZE = (320, 240)


def read(name: str) -> Any:
    return nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)  # type: ignore[no-untyped-call]


def run(notebook: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Run a notebook; return its printed outputs and values as text."""
    from nbclient import NotebookClient

    commands = Path(sys.executable).parent  # of this environment, active or not
    monkeypatch.setenv("PATH", f"{commands}{os.pathsep}{os.environ['PATH']}")
    resources = {"metadata": {"path": folder}}
    NotebookClient(notebook, timeout=900, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    data = [output.get("data", {}) for output in outputs]
    return [
        output.get("text", "") or of.get("text/plain", "")
        for output, of in zip(outputs, data, strict=True)
    ]


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda file: file.stem)
def test_a_notebook_is_kept_without_outputs(file: Path) -> None:
    cells = [cell for cell in read(file.stem).cells if cell.cell_type == "code"]
    assert cells
    assert not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # torch's
def test_photographs_of_two_sizes_are_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the line for a folder of one's own in place of the embedded scene."""
    import matplotlib.pyplot as plt

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
    cells = [cell.source for cell in read("train_photographs").cells if cell.cell_type == "code"]
    source, lines = re.subn(r"^# (scene = )", r"\1", "\n".join(cells), flags=re.MULTILINE)
    assert lines == 1
    source, lines = re.subn(r"train\.steps=100\b", "train.steps=20", source)
    assert lines == 1
    monkeypatch.chdir(tmp_path)
    shown: list[int] = []
    monkeypatch.setattr(plt, "show", lambda: shown.append(plt.gcf().number))
    names: dict[str, Any] = {}

    exec(source, names)  # noqa: S102

    plt.close("all")
    assert len(set(shown)) == 2
    views = names["data"].train
    kinds = {(view.tag, view.camera.width, view.camera.height) for view in views}
    large = {("HR", 160, 120), ("LR", 160, 120)}  # by their distance
    assert kinds - large == {("LR", 80, 60)}
    assert ("HR", 160, 120) in kinds
    gaussians, antialiased = load_gaussians(tmp_path / "scene.ply")
    assert capsys.readouterr().out == f"{len(gaussians)} Gaussians, antialiased=True\n"
    assert antialiased


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:jupyter_client")
def test_two_recipes_are_compared_and_filmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, smoke_variants: Path
) -> None:
    shutil.copytree(smoke_variants, tmp_path / "xrgs-store" / "variants")
    notebook = read("compare_recipes")
    for cell in notebook.cells:
        cell.source = cell.source.replace("--views 12", "--views 2")
    texts = run(notebook, tmp_path, monkeypatch)
    scores, changes = (text for text in texts if text.lstrip().startswith(("psnr", "label")))
    assert {row.split()[0] for row in scores.splitlines()[2:]} == {"baseline", "lean", "plus"}
    assert changes.split()[1:3] == ["lean", "plus"]
    assert (tmp_path / "film.mp4").stat().st_size > 1000
