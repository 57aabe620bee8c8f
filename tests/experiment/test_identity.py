"""Tests that a cell's identity has everything that can change a number, and nothing else."""

from __future__ import annotations

import copy
import dataclasses
import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.evaluation.protocol import PROTOCOL_VERSION
from xrgs.experiment import identity
from xrgs.experiment.identity import cell_identity
from xrgs.safeio import hashing
from xrgs.safeio.hashing import digest
from xrgs.splat.backend import arithmetic, resolve_backend


def cell_id(conf: Conf, variant: str = "v") -> str:
    return digest(cell_identity(conf, variant))


def leaves(value: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return [leaf for f in fields for leaf in leaves(getattr(value, f.name), (*path, f.name))]
    return [path]


def change(conf: Any, path: tuple[str, ...]) -> None:
    """Another value of the same type at a path of the config."""
    for name in path[:-1]:
        conf = getattr(conf, name)
    old = getattr(conf, path[-1])
    match old:
        case bool():
            new: Any = not old
        case int() | float():
            new = old + 1
        case str():
            new = "torch" if path[-1] == "backend" and old != "torch" else old + "x"
        case None:
            new = "x"
        case _:
            new = [value + 1 for value in old]
    setattr(conf, path[-1], new)


def test_every_value_of_training_is_in_it_and_no_other(baseline: Conf) -> None:
    baseline.splat.backend = "torch"
    paths = [p for p in leaves(baseline) if p != ("splat", "backend")]
    assert len(paths) > 40
    before = json.dumps(dataclasses.asdict(baseline))
    for path in paths:
        changed = copy.deepcopy(baseline)
        change(changed, path)
        counts = path[0] in {"splat", "train", "components", "seed"}
        assert (cell_id(changed) != cell_id(baseline)) == counts, path
    assert json.dumps(dataclasses.asdict(baseline)) == before


def test_the_variant_is_in_it(baseline: Conf) -> None:
    assert cell_id(baseline, "v") != cell_id(baseline, "w")


def test_naming_the_backend_that_auto_chooses_is_no_change(baseline: Conf) -> None:
    auto, named = copy.deepcopy(baseline), copy.deepcopy(baseline)
    auto.splat.backend = "auto"
    named.splat.backend = resolve_backend("auto")
    assert cell_id(auto) == cell_id(named)


PACKAGE = Path(identity.__file__).parents[1]


def test_the_code_is_every_file_that_can_change_a_number() -> None:
    names = identity.training_code("torch").keys()
    for folder in ("splat", "training"):
        files = {file.relative_to(PACKAGE).as_posix() for file in (PACKAGE / folder).rglob("*.py")}
        assert files
        assert files <= names
    assert {name for name in names if name.partition("/")[0] not in {"splat", "training"}} == {
        "capture/dataset.py",
        "evaluation/lpips/network.py",
        "evaluation/lpips/weights.py",
        "evaluation/metrics.py",
        "evaluation/protocol.py",
        "safeio/npz.py",  # reads the points that training starts from
    }
    native = identity.training_code("native").keys()
    sources = native - names
    assert names < native
    assert all(name.startswith("csrc/") for name in sources)
    assert any(name.endswith(".cpp") for name in sources)
    assert any(name.endswith(".h") for name in sources)


@pytest.fixture
def copied_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the training code, which is hashed instead of the installed package's."""
    for name in identity.training_code("torch"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes((PACKAGE / name).read_bytes())
    monkeypatch.setattr(hashing, "_PACKAGE", tmp_path)
    identity.training_code.cache_clear()
    yield tmp_path
    identity.training_code.cache_clear()


@pytest.mark.parametrize("name", ["splat/densify.py", "safeio/npz.py"])
def test_a_changed_file_of_the_training_code_is_another_cell(
    baseline: Conf, copied_package: Path, name: str
) -> None:
    before = cell_id(baseline)
    with (copied_package / name).open("a") as file:
        file.write("\n# changed\n")
    assert cell_id(baseline) == before  # read once a process: a plan has one code
    identity.training_code.cache_clear()
    assert cell_id(baseline) != before


def test_files_that_were_changed_added_or_removed_are_named(copied_package: Path) -> None:
    planned = dict(identity.training_code("torch"))
    assert identity.changed_code(planned, "torch") == []
    (copied_package / "splat" / "densify.py").write_text("changed")
    (copied_package / "splat" / "added.py").write_text("")
    (copied_package / "safeio" / "npz.py").unlink()
    names = ["safeio/npz.py", "splat/added.py", "splat/densify.py"]
    assert identity.changed_code(planned, "torch") == names


@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_an_identity_has_these_keys_and_values(baseline: Conf, backend: str) -> None:
    """The hand-over to jobs, status and reports read identities by these keys."""
    baseline.splat.backend = backend
    resolved = resolve_backend(backend)
    values = dataclasses.asdict(baseline)
    assert cell_identity(baseline, "v") == {
        "splat": values["splat"] | {"backend": resolved},
        "train": values["train"],
        "components": values["components"],
        "seed": baseline.seed,
        "variant": "v",
        "protocol": PROTOCOL_VERSION,
        "arithmetic": arithmetic(resolved),
        "code": identity.training_code(resolved),
    }


def test_code_is_compared_for_the_backend_that_is_named() -> None:
    for backend in ("torch", "native"):
        assert identity.changed_code(identity.training_code(backend), backend) == []
    native, torch = (identity.training_code(backend) for backend in ("native", "torch"))
    assert identity.changed_code(native, "torch") == sorted(native.keys() - torch.keys())


def test_the_native_backend_on_a_machine_without_fused_multiply_add_is_another_cell(
    baseline: Conf,
) -> None:
    native = pytest.importorskip("xrgs._native")
    before, found = native.isa(), {}
    try:
        for isa in native.available_isas():
            native.set_isa(isa)
            ids = []
            for backend in ("native", "torch"):
                baseline.splat.backend = backend
                ids.append(cell_id(baseline))
            found[isa] = (native.fused_multiply_add(), *ids)
    finally:
        native.set_isa(before)
    assert all(fused for isa, (fused, *_) in found.items() if isa != "portable")
    for fused, on_native, on_torch in found.values():
        for other_fused, on_other_native, on_other_torch in found.values():
            assert (on_native == on_other_native) == (fused == other_fused)
            assert on_torch == on_other_torch


def test_a_native_module_that_cannot_be_loaded_is_an_error_of_one_line(
    baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Built for another Python or C library: the module is found, and its import fails."""
    pytest.importorskip("xrgs._native")
    baseline.splat.backend = "native"

    def fail(name: str) -> None:
        raise ImportError(f"{name}: version `GLIBC_9.9' not found")

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(XrgsError, match=r"splat\.backend=native: .*GLIBC_9\.9.*install xrgs"):
        cell_id(baseline)


def test_planning_a_native_cell_needs_no_torch() -> None:
    pytest.importorskip("xrgs._native")
    script = (
        "import sys\nfrom xrgs.splat.backend import arithmetic\n"
        "assert arithmetic('native') in {'fma', 'no-fma'}\nassert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-P", "-c", script], check=True)
