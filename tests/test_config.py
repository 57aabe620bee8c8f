"""The schema, `conf/config.yaml` that documents it, and what a composed config becomes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs.composing import error_line, escape_interpolations, from_dict, from_file
from xrgs.config import CONF_DIR, Conf, SplatConf
from xrgs.errors import XrgsError
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings

Compose = Callable[..., Conf]

#: Values of the splat library's own dataclasses, which it has without Hydra.
SETTINGS: dict[str, RasterSettings | OptimizerSettings | DensifySettings] = {
    "raster": RasterSettings(),
    "optimizer": OptimizerSettings(),
    "densify": DensifySettings(),
}


def schema_keys(schema: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of a schema that is no group of keys, with its default."""
    for entry in fields(schema):
        default = getattr(schema, entry.name)
        if is_dataclass(default):
            yield from schema_keys(default, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, default


def yaml_leaves(file: Path) -> Iterator[tuple[str, int, Any]]:
    """Every key of a YAML file that is no group of keys, with its line (from 0) and its value."""

    def walk(node: yaml.Node, prefix: str) -> Iterator[tuple[str, int, Any]]:
        assert isinstance(node, yaml.MappingNode)
        for key, value in node.value:
            name = f"{prefix}{key.value}"
            if isinstance(value, yaml.MappingNode) and value.value:
                yield from walk(value, f"{name}.")
            else:
                yield name, key.start_mark.line, value

    root = yaml.compose(file.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    if root is not None:  # it is None for a file of comments alone
        yield from walk(root, "")


def baseline_leaves() -> dict[str, int]:
    """The keys of `conf/config.yaml` that are the schema's, with their lines."""
    leaves = yaml_leaves(CONF_DIR / "config.yaml")
    return {name: line for name, line, _ in leaves if name != "defaults"}


def test_the_file_of_the_baseline_has_every_key_of_the_schema() -> None:
    keys = {name for name in baseline_leaves() if not name.startswith("hydra.")}
    assert keys == {name for name, _ in schema_keys(Conf())}


def test_every_key_of_the_baseline_has_a_comment() -> None:
    lines = (CONF_DIR / "config.yaml").read_text(encoding="utf-8").splitlines()
    missing = []
    for name, line in baseline_leaves().items():
        indent = re.match(" *", lines[line])
        assert indent is not None
        above = lines[line - 1].startswith(f"{indent[0]}# ")
        if not above and not re.search(r"  # \S.{9}", lines[line]):
            missing.append(name)
    assert not missing


def test_lines_of_the_baseline_fit_a_screen() -> None:
    lines = (CONF_DIR / "config.yaml").read_text(encoding="utf-8").splitlines()
    assert max(map(len, lines)) <= 100


def test_only_the_splat_library_has_values_of_its_own() -> None:
    """Every other value has its one home in `conf/`."""
    defaults = {name for name, default in schema_keys(Conf()) if default not in (MISSING, {})}
    own = {f"splat.{group}.{entry.name}" for group in SETTINGS for entry in fields(SETTINGS[group])}
    assert defaults == own


@pytest.mark.parametrize("group", SETTINGS)
def test_the_splat_librarys_defaults_are_the_baselines(group: str, compose: Compose) -> None:
    """Compared in the file itself and composed with a preset that changes neither of them."""
    expected = asdict(SETTINGS[group])
    in_file = OmegaConf.to_container(OmegaConf.load(CONF_DIR / "config.yaml"), resolve=False)
    assert isinstance(in_file, dict)
    written = in_file["splat"][group]
    composed = asdict(getattr(compose("preset=paper").splat, group))
    for values in (written, composed):
        assert values.keys() == expected.keys()
        for name, value in expected.items():
            given = tuple(values[name]) if isinstance(value, tuple) else values[name]
            assert given == value, name
            assert type(given) is type(value), name


@pytest.mark.parametrize(
    "override",
    [
        "splat.densify.split=middle",
        "splat.densify.budget=-0.1",
        "splat.densify.budget=nan",
        "splat.densify.budget=inf",
    ],
)
def test_an_unknown_split_or_a_wrong_budget_is_refused(compose: Compose, override: str) -> None:
    with pytest.raises(XrgsError, match=f"^{override.split('=', maxsplit=1)[0]}=.*: must be "):
        compose(override)


def test_numbers_are_numbers_to_any_reader_of_yaml() -> None:
    """YAML 1.1 reads `1e-15`, without a point, as a text."""
    for file in CONF_DIR.rglob("*.yaml"):
        for name, _, node in yaml_leaves(file):
            if isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:str":
                assert not re.fullmatch(r"[-+]?[\d.]+e[-+]?\d+", node.value), f"{file.name}: {name}"


@pytest.mark.parametrize("key", ["variant.bogus", "components.loss_weighting.bogus"])
def test_a_key_that_a_plus_adds_to_the_schema_is_refused(compose: Compose, key: str) -> None:
    with pytest.raises(XrgsError, match=f"^{key}: there is no such key"):
        compose(f"+{key}=1")


def test_a_value_that_is_missing_is_named(compose: Compose) -> None:
    with pytest.raises(OmegaConfBaseException, match="factor"):
        compose("variant.factor=???")


@pytest.mark.parametrize(
    "override",
    [
        "splat.optimizer.means_decay_from=-1",
        "splat.optimizer.shN_every=0",
        "train.steps=0",
        "threads=-1",
        "checkpoint_s=-0.5",
        "limits.minutes=nan",
        "limits.memory_gb=-1",
    ],
)
def test_a_value_below_its_least_names_its_key(compose: Compose, override: str) -> None:
    with pytest.raises(XrgsError, match=rf"^{override.partition('=')[0]}=.*: must be at least"):
        compose(override)


@pytest.mark.parametrize("value", ["-0.1", "1", "nan"])
def test_a_share_of_held_out_views_is_from_0_to_below_1(compose: Compose, value: str) -> None:
    with pytest.raises(XrgsError, match=r"^train\.validation=.*: must be from 0 to below 1"):
        compose(f"train.validation={value}")
    assert compose("train.validation=0.999").train.validation == 0.999


@pytest.mark.parametrize("override", ["splat.backend=cuda", "retry=all"])
def test_a_value_that_is_no_choice_names_its_key(compose: Compose, override: str) -> None:
    with pytest.raises(XrgsError, match=f"^{override}: must be one of "):
        compose(override)


def test_values_are_of_their_types_and_interpolations_resolved(compose: Compose) -> None:
    conf = compose("limits.minutes=2", "scene=folder", "scene.path=${data_root}/a", "store=7")
    assert type(conf.limits.minutes) is float
    assert conf.scene.path == "data/llff/a"
    assert conf.store == "7"


texts = st.text(alphabet="${}\\\\ab':.,é")


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(text=texts)
def test_texts_are_taken_literally(baseline: Conf, text: str) -> None:
    conf = replace(
        baseline, store=text, scene=replace(baseline.scene, name="${oc.env:HOME}", path=text)
    )
    assert from_dict(asdict(conf)) == conf


@given(text=texts)
def test_omegaconf_takes_an_escaped_text_literally(text: str) -> None:
    nested = {"a": [text, {"b": text}], "c": 1, "d": None}
    conf = OmegaConf.create(escape_interpolations(nested))
    assert OmegaConf.to_container(conf, resolve=True) == nested


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"", r"config\.json: Expecting value"),
        (b"[1]", r"config\.json: "),
        (b'{"train": {"steps": "many"}}', r"config\.json: .*train\.steps"),
        (b'{"bogus": 1}', r"config\.json: .*bogus.*another version"),
    ],
)
def test_a_file_of_no_config_is_named(tmp_path: Path, content: bytes, named: str) -> None:
    file = tmp_path / "config.json"
    file.write_bytes(content)
    with pytest.raises(XrgsError, match=named):
        from_file(file)


def test_the_line_of_an_error_has_its_key_once() -> None:
    conf = OmegaConf.structured(SplatConf)
    with pytest.raises(OmegaConfBaseException) as raised:
        conf.raster.near = "far"
    line = error_line(raised.value)
    assert line.startswith("raster.near: ")
    assert "\n" not in line
    assert error_line(ValueError("one\ntwo")) == "one"
