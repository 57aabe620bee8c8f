"""A cell's identity: everything that can change a number, and nothing else."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from xrgs.config import Conf
from xrgs.experiment import identity
from xrgs.experiment.identity import cell_identity
from xrgs.safeio import hashing
from xrgs.safeio.hashing import digest


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
        changed = _copy(baseline)
        change(changed, path)
        counts = path[0] in {"splat", "train", "components", "seed"}
        assert (cell_id(changed) != cell_id(baseline)) == counts, path
    assert json.dumps(dataclasses.asdict(baseline)) == before


def _copy(conf: Conf) -> Conf:
    from xrgs.config import from_dict

    return from_dict(dataclasses.asdict(conf))


def test_the_variant_is_in_it(baseline: Conf) -> None:
    assert cell_id(baseline, "v") != cell_id(baseline, "w")


def test_naming_the_backend_that_auto_chooses_is_no_change(baseline: Conf) -> None:
    auto, named = _copy(baseline), _copy(baseline)
    auto.splat.backend = "auto"
    named.splat.backend = identity.resolve_backend("auto")
    assert cell_id(auto) == cell_id(named)


def test_a_changed_file_of_thetraining_code_is_another_cell(
    baseline: Conf, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = cell_id(baseline)
    names = set(cell_identity(baseline, "v")["code"])
    assert {"train.py", "components/base.py", "metrics.py", "splat/densify.py"} <= names
    assert "report/tables.py" not in names
    assert not any(name.startswith("native/") for name in names)
    assert "native/simd.h" in identity.training_code("native")

    package = Path(identity.__file__).parent
    for name in names:
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes((package / name).read_bytes())
    monkeypatch.setattr(hashing, "_PACKAGE", tmp_path)
    identity.training_code.cache_clear()
    assert cell_id(baseline) == before

    with (tmp_path / "splat" / "densify.py").open("a") as file:
        file.write("\n# changed\n")
    identity.training_code.cache_clear()
    assert cell_id(baseline) != before
    identity.training_code.cache_clear()
