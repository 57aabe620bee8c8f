"""The schema, `conf/config.yaml` that documents it, and what a composed config becomes."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import MISSING, Field, asdict, fields, is_dataclass, replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, get_type_hints

import hydra
import pytest
import yaml
from hydra import version
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.version import VersionBase
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import xrgs
from tests.conftest import composed, composed_by_hydra
from xrgs.composing import error_line, escape_interpolations, from_dict, from_file, to_conf
from xrgs.config import (
    CONF_DIR,
    PATHS,
    Conf,
    identity_values,
)
from xrgs.errors import XrgsError
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings

Compose = Callable[..., Conf]

#: Values of the splat library's own dataclasses, which it has without Hydra.
SETTINGS: dict[str, RasterSettings | OptimizerSettings | DensifySettings] = {
    "raster": RasterSettings(),
    "optimizer": OptimizerSettings(),
    "densify": DensifySettings(),
}


@pytest.fixture(scope="module")
def compose() -> Compose:
    """Return the function (*overrides) -> their config, as Hydra composes it."""
    return composed_by_hydra


def schema_keys(schema: type[Any] = Conf, prefix: str = "") -> Iterator[tuple[str, Field[Any]]]:
    """Every key of a schema that is no group of keys, with its declaration."""
    types = get_type_hints(schema)
    for entry in fields(schema):
        if is_dataclass(types[entry.name]):
            yield from schema_keys(types[entry.name], f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, entry


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
    assert keys == {name for name, _ in schema_keys()}


def test_the_values_of_the_baseline_are_of_the_schemas_types() -> None:
    """As they are in the file: OmegaConf would convert `"1"` for a number."""
    conf = OmegaConf.load(CONF_DIR / "config.yaml")
    assert isinstance(conf, DictConfig)
    OmegaConf.update(conf, "scene", {"name": "x", "kind": "folder"}, merge=True)
    names = [entry.name for entry in fields(Conf)]
    values = OmegaConf.to_container(OmegaConf.masked_copy(conf, names), resolve=True)
    assert isinstance(values, dict)
    assert asdict(from_dict(values)).keys() == values.keys()


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
    assert max(map(len, lines)) <= 100, "they fit a screen"


def test_only_the_splat_library_has_values_of_its_own() -> None:
    """Every other value has its one home in `conf/`."""
    defaults = {
        name
        for name, entry in schema_keys()
        if not (entry.default is MISSING and entry.default_factory is MISSING)
    }
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
    ("overrides", "message"),
    [
        ("splat.densify.split=middle", "splat.densify.split=middle: must be "),
        ("splat.densify.budget=nan", "splat.densify.budget=nan: must be "),
        ("splat.densify.noise=-1", "splat.densify.noise=-1.0: must be "),
        ("splat.strategy=mc", "splat.strategy=mc: must be "),
        ("splat.init_scale=0", "splat.init_scale=0.0: must be "),
        # Settings that the strategy does not read.
        ("splat.densify.noise=1", "splat.densify.noise=1.0: must be "),
        ("splat.strategy=mcmc", "splat.densify.budget=0: must be "),
        ("+ablation=[mcmc,long_axis]", "splat.densify.split=long_axis: must be "),
        ("+ablation=[mcmc,absgrad]", "splat.raster.absgrad=True: must be "),
        ("threads=-1", "threads=-1: must be at least"),
        ("limits.minutes=nan", "limits.minutes=nan: must be at least"),
        ("train.validation=1", "train.validation=1.0: must be at least 0 and below 1"),
        ("train.hr_share=-0.1", "train.hr_share=-0.1: must be at least 0 and below 1"),
        ("splat.backend=cuda", "splat.backend=cuda: must be one of "),
        ("retry=all", "retry=all: must be one of "),
        ("splat.sh_every=0", "splat.sh_every=0: must be at least 1"),
        ("splat.init_opacity=1", "splat.init_opacity=1.0: must be above 0 and below 1"),
        ("splat.ssim_weight=1.5", "splat.ssim_weight=1.5: must be at least 0 and at most 1"),
        ("splat.densify.every=-1", "splat.densify.every=-1: must be at least 1"),
        ("splat.densify.reset_every=0", "splat.densify.reset_every=0: must be at least 1"),
        ("splat.optimizer.scales=-1", "splat.optimizer.scales=-1.0: must be at least 0"),
        ("splat.optimizer.beta1=1", "splat.optimizer.beta1=1.0: must be at least 0 and below 1"),
        # Numbers that nothing can hold.
        (f"seed={2**63}", f"seed={2**63}: must be below 2^"),
        (f"variant.sfm.seed={2**63}", f"variant.sfm.seed={2**63}: must be below 2^"),
        (f"+components.plugins.p.n={2**63}", f"components.plugins.p.n={2**63}: must be below 2^"),
        # Numbers that the config.json of a cell can't hold.
        ("splat.optimizer.means=inf", "splat.optimizer.means=inf: must be finite"),
        ("checkpoint_s=inf", "checkpoint_s=inf: must be finite"),
        ("splat.raster.background=[0,nan,0]", "scene.background=[0.0, nan, 0.0]: must be finite"),
        ("+components.plugins.p.x=-inf", "components.plugins.p.x=-inf: must be finite"),
        # Keys that a plus adds to the schema.
        ("+variant.bogus=1", "variant.bogus: there is no such key"),
        ("+components.mip.bogus=1", "components.mip.bogus: there is no such key"),
    ],
)
def test_a_value_that_cannot_be_names_its_key(overrides: str, message: str) -> None:
    with pytest.raises(XrgsError, match=f"^{re.escape(message)}"):
        composed(overrides)


def test_a_number_of_views_that_the_scene_does_not_read_is_refused() -> None:
    folder = ("scene=folder", "scene.path=p")
    assert composed(*folder, "scene.views=24").scene.views == 24  # the baseline's value
    with pytest.raises(XrgsError, match=r"^scene.views=60: .*all photographs of the folder are"):
        composed(*folder, "scene.views=60")


@pytest.mark.slow
def test_a_value_that_no_component_takes_is_refused_before_training(compose: Compose) -> None:
    for group in asdict(compose().components):
        if group in {"plugins", "regularization", "count_matched"}:  # no ablation has their keys
            continue
        values = asdict(compose(f"+ablation={'near_limit' if group == 'floaters' else group}"))
        for name, value in values["components"][group].items():
            wrong = {str: ("other",), int: (-1,), float: (-0.1, math.nan, math.inf)}
            for other in wrong[type(value)]:
                changed = {group: values["components"][group] | {name: other}}
                cfg = values | {"components": values["components"] | changed}
                with pytest.raises(XrgsError, match=f"^components.{group}.{name}=.*: must be "):
                    to_conf(cfg)  # type: ignore[arg-type]


def test_mcmc_takes_the_rendering_of_other_arms(compose: Compose) -> None:
    conf = compose("+ablation=[mcmc,antialiased,supersampled]")
    assert (conf.splat.strategy, conf.splat.raster.antialiased) == ("mcmc", True)
    assert (conf.splat.raster.eps2d, conf.components.supersampled.factor) == (0.1, 2)
    assert conf.splat.densify.noise == 5e5


def test_numbers_are_numbers_to_any_reader_of_yaml() -> None:
    """YAML 1.1 reads `1e-15`, without a point, as a text."""
    for file in CONF_DIR.rglob("*.yaml"):
        for name, _, node in yaml_leaves(file):
            if isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:str":
                assert not re.fullmatch(r"[-+]?[\d.]+e[-+]?\d+", node.value), f"{file.name}: {name}"


def test_a_value_that_is_missing_is_named(compose: Compose) -> None:
    with pytest.raises(OmegaConfBaseException, match="factor"):
        compose("variant.factor=???")


@pytest.mark.slow
def test_every_path_may_begin_with_the_home_folder(
    compose: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/some one")
    conf = compose(*(f"{key}='~/a, b/c'" for key in PATHS if key != "scene.path"))
    paths = [conf.scene.masks, conf.variant.poses, conf.store, conf.data_root]
    assert paths == ["/home/some one/a, b/c"] * 4
    assert compose("scene=folder", "scene.path='~/a/**'").scene.path == "/home/some one/a/**"
    assert compose("scene=llff/fern", "data_root='~/d'").scene.path == "/home/some one/d/fern"
    assert compose("store='~no-such-user/x'").store == "~no-such-user/x"


def test_configs_are_composed_where_hydra_is_in_use_and_leave_it_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in (VersionBase, JobRuntime):
        monkeypatch.setitem(Singleton._instances, kind, kind.__new__(kind))
        type(kind.instance()).__init__(kind.instance())
    (tmp_path / "mine.yaml").write_text("a: 1\n")
    with hydra.initialize_config_dir(str(tmp_path), job_name="mine", version_base="1.2"):
        assert xrgs.compose("seed=3").seed == 3
        with pytest.raises(HydraException):
            xrgs.compose("bogus=3")
        assert str(version.getbase()) == "1.2"
        assert hydra.compose("mine", return_hydra_config=True).hydra.job.name == "mine"


@pytest.mark.slow
def test_configs_are_composed_in_threads() -> None:
    with ThreadPoolExecutor(4) as pool:
        assert [*pool.map(lambda seed: xrgs.compose(f"seed={seed}").seed, range(4))] == [0, 1, 2, 3]


@pytest.mark.slow
def test_a_plain_value_in_a_composed_config_is_hydras() -> None:
    """Other tests set numbers, flags and names without Hydra."""
    values = "train.steps=40 splat.backend=torch splat.densify.budget=1 threads=3 checkpoint_s=1e-9"
    words = (
        *values.split(),
        "variant.sfm.reference=false",
        "splat.optimizer.eps=0.5",
        "store=/a/b",
    )
    folder = ("scene=folder", "scene.path=/a/b")
    for arm in ((), ("+ablation=mip",), ("scene=motorcycle", "preset=smoke"), folder):
        assert composed(*arm, *words) == composed_by_hydra(*arm, *words)
    with pytest.raises(HydraException, match=r"train\.steps=many"):
        composed("train.steps=many")
    for made in (composed, composed_by_hydra):
        with pytest.raises(XrgsError, match=r"^splat\.init_scale=0\.0: must be finite and above 0"):
            made("splat.init_scale=0")


def test_values_are_of_their_types_and_interpolations_resolved(compose: Compose) -> None:
    conf = compose("limits.minutes=2", "scene=folder", "scene.path=${data_root}/a", "store=7")
    assert type(conf.limits.minutes) is float
    assert type(from_dict(asdict(conf) | {"checkpoint_s": 7}).checkpoint_s) is float
    assert conf.scene.path == "data/llff/a"
    assert conf.store == "7"


texts = st.text(alphabet="${}\\\\ab':.,é")


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=texts)
def test_texts_are_taken_literally(baseline: Conf, text: str) -> None:
    conf = replace(
        baseline, store=text, scene=replace(baseline.scene, name="${oc.env:HOME}", path=text)
    )
    assert from_dict(asdict(conf)) == conf


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("train.steps", "many", "train.steps: Expected `int`"),
        ("train.validation", True, "train.validation: Expected `float`"),
        ("train.validation", 10**400, "train.validation: "),
        ("variant.test", ["a", 1], "variant.test[1]: Expected `str`"),
        ("splat.raster.background", [0.0, 0.0], "splat.raster.background: Expected `array`"),
        ("components", [], "components: Expected `object`"),
        ("components.mip.bogus", 1, "components.mip.bogus: there is no such key"),
        ("train.steps", MISSING, "train.steps: is missing"),
        ("components", MISSING, "components.loss_weighting.lr_weight: is missing"),
    ],
)
def test_a_wrong_or_missing_value_is_refused_by_its_key(
    baseline: Conf, key: str, value: object, message: str
) -> None:
    values = asdict(baseline)
    *groups, name = key.split(".")
    group = reduce(getitem, groups, values)
    group[name] = value
    if value is MISSING:
        del group[name]
    with pytest.raises(XrgsError, match=f"^{re.escape(message)}"):
        from_dict(values)


def test_a_file_from_before_a_key_was_added_takes_the_baselines_value(
    baseline: Conf, tmp_path: Path
) -> None:
    values = asdict(baseline)
    del (
        values["components"]["resolution_schedule"],
        values["splat"]["raster"]["absgrad"],
        values["limits"],
        values["lpips"],
    )
    (file := tmp_path / "config.json").write_text(json.dumps(values))
    conf, added = from_file(file)
    assert conf == baseline
    assert added == {
        "splat.raster.absgrad": False,
        "components.resolution_schedule.start_share": 1.0,
        "components.resolution_schedule.until": 15_000,  # in the file, splat.densify.stop
        "limits.minutes": 0.0,
        "limits.memory_gb": 0.0,
        "lpips.fetch": False,  # by the variable of the environment that the tests set
    }


def test_a_file_from_before_components_were_moved_out_has_their_plugins(
    baseline: Conf, tmp_path: Path
) -> None:
    """Those that were on; what was off leaves nothing."""
    skipping = {"share": 0.5, "tolerance": 0.0, "decay": 0.95, "begin": 15_000}
    for on in (True, False):
        values = asdict(baseline)
        values["components"]["skip_backward"] = skipping | ({} if on else {"share": 1.0})
        values["components"]["error_score"] = {"of": "nothing", "views": 10}
        values["components"]["floaters"]["gradient_share"] = 0.5 if on else 0.0
        values["components"]["mip"] |= {"variance": 0.2 * on, "until": 20_000}
        (file := tmp_path / "config.json").write_text(json.dumps(values))
        conf, added = from_file(file)
        moved = {
            "skip_backward": skipping,
            "near_gradients": {"share": 0.5},
            "mip_off_late": {"variance": 0.2, "every": 100, "until": 20_000},
        }
        assert conf.components.plugins == (moved if on else {})
        conf.components.plugins = {}
        assert (conf, added) == (baseline, {})


def test_the_baseline_has_no_component_in_its_identity(compose: Compose) -> None:
    conf = compose()
    assert identity_values(conf.components) == {}
    assert identity_values(conf.train) == {"steps": conf.train.steps, "views": "mixed"}


def test_an_identity_has_what_is_on(compose: Compose) -> None:
    conf = compose(
        "components.mip.variance=0.2",
        "components.supersampled.late_factor=2",
        "components.consistency.l1=0.5",
        "+components.plugins.one.weight=0.5",
        "splat.raster.antialiased=true",
    )
    assert identity_values(conf.components) == {
        "supersampled": {"late_factor": 2, "late_from": 15_000},
        "mip": {"variance": 0.2, "every": 100},
        "plugins": {"one": {"weight": 0.5}},
    }
    raster = identity_values(conf.splat)["raster"]
    assert raster["antialiased"] is True
    assert "absgrad" not in raster
    assert json.loads(json.dumps(raster)) == raster


@given(text=texts)
def test_omegaconf_takes_an_escaped_text_literally(text: str) -> None:
    conf = OmegaConf.create({"a": escape_interpolations(text)})
    assert OmegaConf.to_container(conf, resolve=True) == {"a": text}


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"", r"config\.json: not valid JSON"),
        (b'{"scene": {"name": 1, "kind": "folder"}}', r"config\.json: scene\.name: Expected"),
        (b'{"bogus": 1}', r"config\.json: bogus: there is no such key.*another version"),
        (b"{}", r"config\.json: scene\.name: is missing"),
    ],
)
def test_a_file_of_no_config_is_named(tmp_path: Path, content: bytes, named: str) -> None:
    file = tmp_path / "config.json"
    file.write_bytes(content)
    with pytest.raises(XrgsError, match=named):
        from_file(file)


def test_the_line_of_an_error_has_its_key_once() -> None:
    conf = OmegaConf.create({"raster": RasterSettings})
    with pytest.raises(OmegaConfBaseException) as raised:
        conf.raster.near = "far"
    line = error_line(raised.value)
    assert line.startswith("raster.near: ")
    assert "\n" not in line
    assert error_line(ValueError("one\ntwo")) == "one"
