"""Components of other packages: found and hashed without an import, then built from the config."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from tests.conftest import composed as compose
from xrgs import plugins
from xrgs.composing import from_dict
from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.safeio import code
from xrgs.store import identity
from xrgs.store.identity import cell_id, cell_identity, changed_code
from xrgs.sweep.plan import check_plugins
from xrgs.training import components
from xrgs.training.components import Components
from xrgs.training.dataset import Dataset

#: (folder, dist, entry points as name -> value, **sources by dotted module)
Install = Callable[..., Path]

#: A component with two settings and without hooks, which are not what is tested here.
SOURCE = """
from dataclasses import dataclass

from xrgs.training.components import Component


@dataclass
class Settings:
    weight: float
    rounds: int = 3


class Plugin(Component):
    settings_type = Settings

    def __init__(self, settings):
        self.settings = settings

    @classmethod
    def from_settings(cls, settings, setup):
        if settings.weight == 13:
            raise ValueError("an unlucky number")
        return None if settings.weight == 0 else cls(settings)
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a package, as pip lays it out, in a folder on `sys.path`."""
    monkeypatch.syspath_prepend(tmp_path)
    identity.training_code.cache_clear()

    def installed(dist: str, points: dict[str, str], sources: dict[str, str]) -> Path:
        info = tmp_path / f"{dist}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {dist}\nVersion: 1.0\n")
        lines = [f"{name} = {value}" for name, value in points.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{plugins.GROUP}]", *lines]))
        for name, source in sources.items():
            file = tmp_path / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(source)
        return tmp_path

    yield installed
    identity.training_code.cache_clear()
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def build(baseline: Conf, data: Dataset, **values: object) -> Components:
    baseline.components.plugins = dict(values)
    return components.build(baseline.components, data, baseline.splat)


def test_a_plugin_is_built_from_its_settings(
    install: Install, baseline: Conf, data: Dataset
) -> None:
    install("dist", {"second": "one:Plugin", "first": "one:Plugin"}, {"one.py": SOURCE})
    assert {"first", "second"} <= set(plugins.installed())
    assert build(baseline, data, first={"weight": 0}) == ()
    baseline.components.render_scale.gamma = 0.25
    built = build(baseline, data, second={"weight": 1}, first={"weight": 0.5, "rounds": 7})
    assert [type(component).__name__ for component in built] == ["RenderScale", "Plugin", "Plugin"]
    settings = [vars(component)["settings"] for component in built[1:]]
    assert [asdict(values) for values in settings] == [
        {"weight": 0.5, "rounds": 7},
        {"weight": 1.0, "rounds": 3},
    ]
    assert type(settings[1].weight) is float


def test_an_unknown_name_lists_those_that_are_installed(
    install: Install, baseline: Conf, data: Dataset
) -> None:
    install("dist", {"one": "one:Plugin", "two": "one:Plugin"}, {"one.py": SOURCE})
    with pytest.raises(
        XrgsError, match=r"^components\.plugins\.wun: .*installed are: .*one, .*two"
    ):
        build(baseline, data, wun={})
    with pytest.raises(XrgsError, match=r"^components\.plugins\.wun: "):
        cell_identity(baseline, "v")


def test_one_name_in_two_packages_is_refused(install: Install) -> None:
    install("left", {"one": "left:Plugin"}, {"left.py": SOURCE})
    install("right", {"one": "right:Plugin"}, {"right.py": SOURCE})
    with pytest.raises(XrgsError, match=r"plugins\.one: left and right offer"):
        plugins.find("one")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"wieght": 1.0}, r"\.wieght: there is no such setting; there are: weight, rounds"),
        ({}, r"\.weight: is missing"),
        ({"weight": "1.0"}, r"\.weight=1\.0: must be of type float"),
        ({"weight": 1, "rounds": 2.5}, r"\.rounds=2\.5: must be of type int"),
        ({"weight": 13}, r": ValueError: an unlucky number"),
    ],
)
def test_a_wrong_setting_names_its_key(
    values: dict[str, object], message: str, install: Install, baseline: Conf, data: Dataset
) -> None:
    install("dist", {"one": "one:Plugin"}, {"one.py": SOURCE})
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.one{message}"):
        build(baseline, data, one=values)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("import no_such_module", "importing one:Plugin failed: ModuleNotFoundError"),
        ("", "importing one:Plugin failed: AttributeError"),
        ("class Plugin: pass", "entry point one:Plugin must name a subclass"),
        (
            "from xrgs.training.components import Component as Plugin",
            "Component must define settings_type",
        ),
    ],
)
def test_a_package_that_is_no_component_names_the_key(
    source: str, message: str, install: Install, baseline: Conf, data: Dataset
) -> None:
    install("dist", {"one": "one:Plugin"}, {"one.py": source})
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.one: .*{message}"):
        build(baseline, data, one={"weight": 1})


def test_a_plugin_without_source_is_refused(install: Install) -> None:
    install("dist", {"one": "not_there:Plugin", "two": "space.not_there:Plugin"}, {"space/x": ""})
    for name in ("one", "two"):
        with pytest.raises(XrgsError, match=rf"plugins\.{name}: .*names no module"):
            plugins.code_digest(name, identity.CODE)


@pytest.mark.slow
def test_the_identity_has_the_source_and_imports_none_of_it(
    install: Install, baseline: Conf
) -> None:
    """Each file raises an error when it is imported."""
    counts = {
        "package/__init__.py": "a",
        "package/deep/kernel.cpp": "a",
        "package/deep/table.json": "a",
        "space/inner/__init__.py": "b",
        "space/inner/part.py": "b",
        "single.py": "c",
    }
    other = ("package/__pycache__/x.cpython-311.pyc", "package/.cache/x", "space/other/__init__.py")
    points = {"a": "package.part:Plugin", "b": "space.inner.part:Plugin", "c": "single:Plugin"}
    folder = install("dist", points, dict.fromkeys([*counts, *other], "1 / 0"))
    baseline.components.plugins = {name: {} for name in points}
    before = {name: plugins.code_digest(name, identity.CODE) for name in points}
    code = cell_identity(baseline, "v").code
    assert {f"plugins/{name}": value for name, value in before.items()}.items() <= code.items()
    for file in (*counts, *other):
        (folder / file).write_text("2 / 0")
        changed = {
            name for name in points if plugins.code_digest(name, identity.CODE) != before[name]
        }
        assert changed == ({counts[file]} if file in counts else set()), file
        (folder / file).write_text("1 / 0")
    assert not {"package", "space", "space.inner", "single"} & set(sys.modules)


@pytest.mark.parametrize("changed", ["source", "settings", "entry point"])
def test_a_change_of_a_plugin_is_another_cell(
    changed: str, install: Install, baseline: Conf
) -> None:
    folder = install("dist", {"one": "one:Plugin"}, {"one.py": SOURCE})
    baseline.components.plugins = {"one": {"weight": 1.0}}
    before = cell_identity(baseline, "v")
    assert changed_code(before) == []
    if changed == "source":
        (folder / "one.py").write_text(SOURCE.replace("13", "14"))
    elif changed == "settings":
        baseline.components.plugins = {"one": {"weight": 2.0}}
    else:
        points = folder / "dist-1.0.dist-info" / "entry_points.txt"
        points.write_text(points.read_text().replace("Plugin", "OtherPlugin"))
    identity.training_code.cache_clear()
    assert cell_id(cell_identity(baseline, "v")) != cell_id(before)
    assert changed_code(before) == ([] if changed == "settings" else ["plugins/one"])


@pytest.mark.slow
def test_the_built_in_components_that_a_plugin_extends_are_part_of_its_code(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugin = install("dist", {"one": "one:Plugin"}, {"one.py": SOURCE}) / "one.py"
    copy = shutil.copytree(code.PACKAGE, tmp_path / "xrgs") / "training/components"
    monkeypatch.setattr(code, "PACKAGE", tmp_path / "xrgs")

    def edited(*files: Path) -> str:
        texts = {file: file.read_text() for file in files}
        for file, text in texts.items():
            file.write_text(f"{text}\nEDITED = 1\n")
        found = plugins.code_digest("one", identity.CODE)
        for file, text in texts.items():
            file.write_text(text)
        return found

    for line, counts in (
        ("from xrgs.training.components.exposure import Exposure", {"exposure", "adam"}),
        ("from xrgs.training.components import exposure", {"exposure", "adam"}),
        ("import xrgs.training.components.mip as filtered", {"mip"}),
        ("from xrgs.training.components.base import Component", set()),
    ):
        plugin.write_text(f"{line}\n{SOURCE}")
        before = plugins.code_digest("one", identity.CODE)
        others = [file for file in copy.glob("*.py") if file.stem not in counts]
        assert len(others) > 10
        assert edited(*others) == before, line
        assert all(edited(copy / f"{name}.py") != before for name in counts), line


def test_settings_come_from_the_command_line() -> None:
    conf = compose("+components.plugins.one.weight=0.5", "+components.plugins.one.deep={a: [1, 2]}")
    assert conf.components.plugins == {"one": {"weight": 0.5, "deep": {"a": [1, 2]}}}
    assert from_dict(asdict(conf)) == conf
    with pytest.raises(XrgsError, match=r"^components\.plugins\.one=0\.5: must be a mapping"):
        compose("+components.plugins.one=0.5")


def test_a_plan_imports_a_plugin_only_for_a_dry_run(install: Install, baseline: Conf) -> None:
    install("dist", {"one": "planned:Plugin", "none": "planned:Settings"}, {"planned.py": SOURCE})
    baseline.components.plugins = {"one": {"wieght": 1.0}}
    check_plugins([baseline], imported=False)
    assert "planned" not in sys.modules
    with pytest.raises(XrgsError, match=r"^components\.plugins\.one\.wieght: there is no "):
        check_plugins([baseline], imported=True)
    baseline.components.plugins = {"one": {"weight": 1.0}}
    check_plugins([baseline], imported=True)
    baseline.components.plugins = {"none": {}}
    with pytest.raises(XrgsError, match=r"none: its entry point planned:Settings must name a sub"):
        check_plugins([baseline], imported=True)
    baseline.components.plugins = {"gone": {}}
    with pytest.raises(XrgsError, match=r"gone: no installed package offers a component"):
        check_plugins([baseline], imported=False)
