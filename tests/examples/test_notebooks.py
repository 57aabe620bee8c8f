"""The notebooks of `examples/` run from first to last cell, and are kept without outputs."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat
import pytest
from IPython.core.inputtransformer2 import TransformerManager

from xrgs import compose, load_gaussians

EXAMPLES = Path(__file__).parents[2] / "examples"

pytestmark = pytest.mark.filterwarnings(
    "ignore:__array__ implementation:DeprecationWarning"
)  # torch


def sources(name: str) -> str:
    """The code of a notebook; it has no outputs."""
    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)  # type: ignore[no-untyped-call]
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    return "\n".join(cell.source for cell in cells)


def changed(source: str, changes: dict[str, str]) -> str:
    """The code with other words at patterns that are there once."""
    for old, new in changes.items():
        source, times = re.subn(old, new, source, flags=re.MULTILINE)
        assert times == 1, old
    return source


def run(source: str, system: Callable[[str], None]) -> tuple[dict[str, Any], list[Any]]:
    """Run a notebook's code as Jupyter does; return its names, and the values of expressions."""
    names: dict[str, Any] = {
        "get_ipython": lambda: SimpleNamespace(system=lambda line: system(line.format(**names)))
    }
    values = []
    for node in ast.parse(TransformerManager().transform_cell(source)).body:
        if isinstance(node, ast.Expr):
            values.append(eval(compile(ast.Expression(node.value), "<cell>", "eval"), names))  # noqa: S307
        else:
            exec(compile(ast.Module([node], []), "<cell>", "exec"), names)  # noqa: S102
    return names, values


@pytest.mark.slow
def test_photographs_are_trained(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    smoke_variants: Path,
) -> None:
    """With a stereo pair, whose variant is there, in place of the embedded scene."""
    import matplotlib.pyplot as plt

    shutil.copytree(smoke_variants, tmp_path / "xrgs-store" / "variants")
    monkeypatch.chdir(tmp_path)
    shown: list[int] = []
    monkeypatch.setattr(plt, "show", lambda: shown.append(plt.gcf().number))
    source = sources("train_photographs")
    (folder,) = re.findall(r"^# scene = (\[.*?\])", source, flags=re.MULTILINE)
    assert compose(*ast.literal_eval(folder)).scene.path == "garden"  # the line for one's own
    pair = {"^scene = .*": 'scene = ["scene=motorcycle", "preset=smoke"]'}
    quick = {r"^quick = .*train.*": 'quick = ["train.steps=20"]'}

    names, values = run(changed(source, pair | quick), pytest.fail)

    plt.close("all")
    assert len(set(shown)) == 2
    assert [row[0] for row in values[0].values] == [view.name for view in names["data"].train]
    gaussians, antialiased = load_gaussians(tmp_path / "scene.ply")
    assert capsys.readouterr().out == f"{len(gaussians)} Gaussians, antialiased=True\n"
    assert antialiased


@pytest.mark.slow
def test_two_recipes_are_compared_and_filmed(
    tmp_path: Path, swept: tuple[Path, str], call_command: Callable[..., tuple[int, str, str]]
) -> None:
    """With the cells of another sweep; its own is planned."""
    shutil.copytree(swept[0] / "s", tmp_path / "xrgs-store")
    plans: list[str] = []

    def system(line: str) -> None:
        name, *arguments = shlex.split(line)
        dry = ["dry_run=true"] * (name == "xrgs-sweep")
        code, _, err = call_command(name.removeprefix("xrgs-"), *arguments, *dry)
        assert code == 0, err
        plans.extend(line for line in err.splitlines() if dry and line.startswith("plan:"))

    smaller = {r'\["plus"\]': '["consistency"]', "views 12": "views 2"}
    _, values = run(changed(sources("compare_recipes"), smaller), system)
    assert [plan.partition(",")[0] for plan in plans] == ["plan: 3 cells"]
    scores, changes = (value for value in values if hasattr(value, "columns"))
    assert set(scores.index) == {"baseline", "consistency"}
    assert [*changes.columns] == ["consistency"]
    assert (tmp_path / "film.mp4").stat().st_size > 1000
