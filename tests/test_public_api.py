"""`import xrgs`: every public name is there, documented, and imported when it is first used."""

from __future__ import annotations

import ast
import inspect
import os
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

import xrgs
from tests.runtime.programs import run_python
from xrgs.config import Conf
from xrgs.training import count_matching
from xrgs.training.dataset import Dataset

HEAVY = ("torch", "pandas", "numpy", "hydra", "kornia", "pycolmap", "matplotlib", "skimage")
#: Names for planning and for looking at results; using them must not import torch.
WITHOUT_TORCH = ("RasterSettings", "Store", "XrgsError", "compose")


def python(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a new interpreter, with no policy of OpenMP but in `environment`."""
    kept = {name: text for name, text in os.environ.items() if name != "OMP_WAIT_POLICY"}
    return run_python(script, check=True, env=kept | environment)


def test_import_is_light() -> None:
    script = f"import sys, xrgs; dir(xrgs); print(*sorted(set({HEAVY}) & set(sys.modules)))"
    light = "; ".join(f"xrgs.{name}" for name in WITHOUT_TORCH)
    assert python(f"{script}; {light}; print('torch' in sys.modules)").stdout == "\nFalse\n"


#: Stands for an import of torch, which takes seconds.
IMPORTED = "sys.modules['torch'] = None"
#: Prints whether the warning is still due, after a name that renders nothing and after others.
USED = f"""
{IMPORTED}
for names in ("load_gaussians",), ("train", "rasterize", "train"):
    for name in names:
        try:
            getattr(xrgs, name)
        except ImportError as error:
            assert error.name == "torch", error
    print(xrgs._SPINNING)
"""


@pytest.mark.slow
def test_openmps_threads_sleep_unless_the_environment_says_otherwise() -> None:
    done = python(f"import os, sys, xrgs; print(os.environ['OMP_WAIT_POLICY'])\n{USED}")
    assert (done.stdout.split(), done.stderr) == (["passive", "False", "False"], "")
    done = python("import os, xrgs; print(os.environ['OMP_WAIT_POLICY'])", OMP_WAIT_POLICY="active")
    assert (done.stdout.split(), done.stderr) == (["active"], "")


@pytest.mark.slow
def test_torch_before_xrgs_is_warned_of_once_where_something_renders() -> None:
    script = f"import sys; {IMPORTED}; import xrgs\n"
    done = python(script + USED)
    assert done.stdout.split() == ["True", "False"]
    assert done.stderr.count("import xrgs before torch, or set OMP_WAIT_POLICY=passive") == 1
    done = python(f"{script}print(xrgs._SPINNING)", OMP_WAIT_POLICY="passive")
    assert done.stdout.split() == ["False"]


def test_a_name_that_will_go_works_and_says_what_to_use() -> None:
    for name in ("load_ply", "rasterization", "save_ply"):
        with pytest.warns(
            DeprecationWarning, match=rf"xrgs\.{name} will be removed .*: use xrgs\."
        ):
            found = getattr(xrgs, name)
        assert found.__name__ == name
        assert name not in xrgs.__all__


def static_imports() -> dict[str, str]:
    """The public names that type checkers see, with their modules."""
    tree = ast.parse(Path(xrgs.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    modules: dict[str, str] = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        modules |= {alias.asname or alias.name: str(node.module) for alias in node.names}
    return modules


def test_type_checkers_and_python_see_the_same_names() -> None:
    assert static_imports() == xrgs._MODULES
    assert sorted(xrgs.__all__) == sorted(xrgs._MODULES)
    assert set(xrgs.__all__) <= set(dir(xrgs))


@pytest.mark.parametrize("name", xrgs.__all__)
def test_every_name_is_there_and_documented(name: str) -> None:
    value = getattr(xrgs, name)
    assert not isinstance(value, ModuleType)
    assert value.__name__ == xrgs._NAMES_IN_MODULES.get(name, name)
    assert value.__module__ == xrgs._MODULES[name] or inspect.isfunction(value)
    text = inspect.getdoc(value) or ""
    assert text.splitlines()[0].endswith(".")
    if inspect.isfunction(value):
        names = [p for p in inspect.signature(value).parameters if p not in {"args", "kwargs"}]
        assert all(f"{parameter}:" in text for parameter in names), f"{name} lacks Args"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'xrgs' has no attribute 'rasterise'"):
        xrgs.rasterise  # type: ignore[attr-defined]  # noqa: B018


def test_train_matches_counts_where_its_config_says_so(
    data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    matched: list[int] = []
    monkeypatch.setattr(
        count_matching.ThresholdSearch, "run", lambda search, _: matched.append(search.target)
    )
    baseline.components.count_matched.gaussians = 70
    xrgs.train(data, baseline)
    assert matched == [70]
