"""Tests of Hydra's overrides on a command line: paths with any character, and typos."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf.errors import ConfigKeyError

from tests.conftest import composed_by_hydra
from xrgs import config
from xrgs.cli.overrides import explained, replaced_words, with_options_first, with_quotes
from xrgs.cli.sweep import texts
from xrgs.composing import ARMS
from xrgs.errors import XrgsError
from xrgs.sweep.axes import expand

RunCommand = Callable[..., tuple[int, str, str]]
ACCENT = "e\N{COMBINING ACUTE ACCENT}"
WHOLE = "\N{LATIN SMALL LETTER E WITH ACUTE}"
ODD = (
    *("a b", " lead", "trail ", "-x", "~nobody", "50%", "a=b", "it's", 'q"q', "#h", "!x", "[x]"),
    *("{y}", "(p)", "$x", "a:b", "*", ACCENT, WHOLE, "🙂", "1e3", "true", "007", "a\\b'"),
)


@pytest.fixture(scope="module")
def compose() -> Callable[..., config.Conf]:
    """Return the function (*overrides) -> their config, as Hydra composes it."""
    return composed_by_hydra


def parsed(word: str) -> object:
    """Return what Hydra reads from a word that was given quotes."""
    (override,) = OverridesParser.create().parse_overrides(with_quotes([word]))
    return override.value()


@pytest.mark.parametrize("name", ODD)
def test_hydra_reads_a_path_as_it_was_written(name: str) -> None:
    found = parsed(f"scene.path={name}")
    assert getattr(found, "text", found) == name
    assert texts([f"store={name}"]).store == name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a,b", "null", "${y}"])
def test_a_word_that_hydra_reads_otherwise_is_a_path_if_it_exists(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compose: Callable[..., config.Conf]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    assert compose(*with_quotes([f"scene.path={name}"])).scene.path == name


@pytest.mark.parametrize("name", [*ODD, "100_7100", "null", "${y}", "IMG(1)", "+p"])
def test_names_of_views_are_read_as_they_were_written(name: str) -> None:
    name = name.strip()
    escaped = name.replace("${", r"\${")
    assert parsed(f"variant.test=[IMG_1, {name}]") == ["IMG_1", escaped]
    assert parsed(f"variant.test=IMG_1,{name}") == ["IMG_1", escaped]


@pytest.mark.parametrize("name", ["it's, that's", "${y}", "null"])
def test_names_are_in_a_config_as_they_were_written(
    name: str, compose: Callable[..., config.Conf]
) -> None:
    assert compose(*with_quotes([f"scene.name={name}"])).scene.name == name
    if "," not in name:
        assert compose(*with_quotes([f"variant.test=[{name}]"])).variant.test == [name]


@pytest.mark.parametrize(
    ("value", "lists"),
    [
        ("[]", [[]]),
        ("[a,b],[c]", [["a", "b"], ["c"]]),
        ("['a,b',\"c\"]", [["a,b", "c"]]),
        ("[IMG(1,2),x]", [["IMG(1,2)", "x"]]),
        ("[it's,that's]", [["it's", "that's"]]),
    ],
)
def test_lists_of_names_are_lists_and_axes(value: str, lists: list[list[str]]) -> None:
    specs = expand(with_quotes([f"variant.test={value}"]))
    found = [OverridesParser.create().parse_override(*spec.overrides).value() for spec in specs]
    assert found == lists


@pytest.mark.slow
def test_files_of_groups_may_have_any_name(tmp_path: Path, sweep_here: RunCommand) -> None:
    (tmp_path / "scene").mkdir()
    for name in ("é (1)", "a=b"):
        (tmp_path / "scene" / f"{name}.yaml").write_text("name: x\nkind: motorcycle\n")
    code, _, err = sweep_here(
        f"--config-dir={tmp_path}", "scene=é (1),a=b", "dry_run=true", "variant.test_every=0"
    )
    assert code == 0, err
    assert "plan: 2 cells" in err


def test_lists_quotes_and_other_keys_stay_as_they_are(tmp_path: Path) -> None:
    words = ["scene.path=a,b", "scene.path='é'", "seed=range(0,9)", "label=é", "+ablation=[a,b]"]
    assert with_quotes(words) == words
    assert with_quotes(["scene.path=é,b c"]) == ["scene.path='é',b c"]
    (tmp_path / "a, b").mkdir()
    (override,) = with_quotes([f"scene.path={tmp_path}/a, b/**"])
    assert override == f"scene.path='{tmp_path}/a, b/**'"
    with pytest.raises(XrgsError, match=r"store=\\udcff.*not valid Unicode"):
        with_quotes(["store=\udcff"])
    for key in config.PATHS:  # a variable of the shell that is not set
        with pytest.raises(XrgsError, match=rf"^{key}=: is empty; give a path, or leave it out"):
            with_quotes([f"{key}="])


@pytest.mark.parametrize(
    ("written", "given"),
    [
        ("seed=0,1", "--multirun seed=0,1"),
        ("seed=0 -m +ablation=mip", "--multirun seed=0 +ablation=mip"),
        ("seed=0 --config-dir my ~x", "--config-dir my --multirun seed=0 ~x"),
        ("seed=0 --cfg job threads=1", "--cfg job seed=0 threads=1"),
        ("-m -c job --resolve seed=0", "-c job --resolve seed=0"),
        ("seed=0 --info", "--info all seed=0"),
        ("seed=0 hydra.mode=RUN", "seed=0 hydra.mode=RUN"),
        ("--config-dir ~/my", "--config-dir /home/me/my --multirun"),
    ],
)
def test_options_of_hydra_may_stand_anywhere(
    written: str, given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    assert with_options_first(written.split()) == given.split()


@pytest.mark.parametrize("name", ["50", "0.5", "1e3", "007", "true", "null"])
def test_files_of_groups_may_have_names_that_yaml_reads_as_numbers(name: str) -> None:
    assert parsed(f"+ablation={name}") == name
    assert parsed(f"+ablation=[mip, {name}]") == ["mip", name]
    (_, first, second) = expand(with_quotes([f"+ablation={name},mip"]))
    assert [first.label, second.label] == [name, "mip"]


@pytest.mark.parametrize(
    ("axis", "wrong", "named"),
    [
        ("seed=0,1", "limits.minutes=1h", "limits.minutes"),
        ("+ablation=mip,lean", "variant=bx", "did you mean box"),
        ("seed=0,1", "store=a seed=[1", "seed=[1"),
    ],
)
def test_a_mistake_beside_an_axis_is_named_and_not_the_axis(
    sweep_here: RunCommand, axis: str, wrong: str, named: str
) -> None:
    code, _, err = sweep_here("scene=motorcycle", axis, *wrong.split(), "dry_run=true")
    assert code == 1
    assert named in err
    assert "Ambiguous" not in err


HEAD = "# @package _global_\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("components: {mip: {every: 3}}", "ablation/mine.yaml: its first line must be `# @package"),
        (HEAD + "components: {mip: {evry: 3}}", "ablation/mine.yaml: components.mip.evry"),
        (HEAD + "component: {mip: {every: 3}}", "'component' not in 'Conf'; did you mean compon"),
        (HEAD + "components: {mip: {every: x}}", "components.mip.every: Value 'x' of type 'str'"),
        (HEAD + "components: {plugins: {3: {}}}", "components.plugins.3: Key 3 (int)"),
        (HEAD + "seed: [", "a YAML file of the config can't be read: .*mine.yaml"),
        (HEAD + "seed: \udcff", "ablation/mine.yaml: is not in UTF-8"),
        (HEAD + "- a\n- b", "ablation/mine.yaml: is a list; it must have lines KEY: VALUE"),
        (HEAD + "train: 30", "ablation/mine.yaml: train: takes keys of its own, and not 30"),
        (HEAD + "just words", "ablation/mine.yaml: Key 'just words' not in"),
        (HEAD + "3", "ablation/mine.yaml: must have lines KEY: VALUE"),
    ],
)
def test_a_mistake_in_a_file_of_the_users_own_is_named(
    sweep_here: RunCommand, tmp_path: Path, content: str, named: str
) -> None:
    (tmp_path / "ablation").mkdir()
    (tmp_path / "ablation/mine.yaml").write_bytes(content.encode(errors="surrogateescape"))
    code, _, err = sweep_here("+ablation=mine", "--config-dir", str(tmp_path), "dry_run=true")
    assert code == 1
    assert re.search(re.escape(named).replace(r"\.\*", ".*"), err), err


@pytest.mark.slow
def test_an_axis_of_the_sweepers_own_settings_and_a_glob_are_planned(
    sweep_here: RunCommand,
) -> None:
    own = '+hydra.sweeper.params.seed="0,1"'
    glob = "+ablation=glob(near*)"  # every file of its group of that name
    code, _, err = sweep_here("scene=motorcycle", "variant.test_every=0", own, glob, "dry_run=true")
    assert (code, "plan: 4 cells" in err, "/ near_limit /" in err) == (0, True, True)


def test_an_arm_of_the_package_of_arms_is_named_with_it(sweep_here: RunCommand) -> None:
    files = Path(__file__).parents[2].glob("examples/arms/conf/ablation/*.yaml")
    assert {file.stem for file in files} == ARMS
    arm = min(ARMS)
    code, _, err = sweep_here(f"+ablation=[keep_large,{arm}]", "dry_run=true")
    assert code == 1
    assert f"ablation={arm}: it is in a package of its own: pip install ./examples/arms" in err


@pytest.mark.slow
def test_the_home_folder_of_a_store_is_not_a_folder_called_tilde(
    sweep_here: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, children: object
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    sweep_here("scene=motorcycle", "preset=smoke", "+ablation=baseline", "store=~/s")
    assert (tmp_path / "home/s/cells").is_dir()
    assert not (tmp_path / "~").exists()


def test_help_and_a_sweep_with_nothing_say_what_to_type(
    sweep_here: RunCommand, tmp_path: Path
) -> None:
    code, out, _ = sweep_here("--help")
    assert code == 0
    for name in ("consistency", "llff/fern", "motorcycle", "laptop", "smoke"):
        assert name in out
    code, out, err = sweep_here()
    assert (code, out) == (2, "")
    assert "xrgs-train FOLDER" in err
    assert "xrgs-sweep +ablation=consistency" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [HydraException, ConfigKeyError])
def test_an_error_of_hydra_is_one_line_with_a_hint(kind: type[Exception]) -> None:
    with pytest.raises(XrgsError, match=r"^two \(hint\)$"), explained(" (hint)"):
        raise kind("two\nlines")


def test_an_error_of_a_file_that_is_no_yaml_of_the_config_stays(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), explained():
        (tmp_path / "gone").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scene=fern"], "scene=fern: there is no such choice; did you mean llff/fern?"),
        (["+steps=100"], "steps: there is no such key; did you mean train.steps"),
        (["train={stepz:5}"], "train.stepz: there is no such key; did you mean train.steps"),
        (["variant={sfm:{sed:1}}"], "variant.sfm.sed: there is no such key; did you mean variant"),
        (["seed=null"], "seed: takes a value, and not null"),
        (["ablaton=consistency"], "ablaton: there is no such key; did you mean ablation?"),
        (["seed=["], "seed=[: "),
        (["garden"], "garden: to train on these photographs, type: xrgs-train garden"),
        (["plus"], "plus: an ablation is given as +ablation=plus"),
        (["fern"], "fern: a scene is given as scene=llff/fern"),
        (["scene=./my photos"], "is given as scene=folder 'scene.path=./my photos'"),
        (["nothing"], "nothing: write KEY=VALUE"),
        (["=5"], "=5: write KEY=VALUE"),
        (["--seed", "3"], "--seed: there is no such option; write seed=3"),
        (["--fail-fast"], "--fail-fast: there is no such option; write fail_fast=true"),
        (["--minutes", "3"], "--minutes: there is no such option; see xrgs-sweep --help"),
        (["+ablation=a,", "b"], "write it without the space: +ablation=a,b"),
        (["+ablation=[a,", "b]"], "write it without the space: '+ablation=[a,b]'"),
        (["+ablation=qqqq"], "there is no such choice; xrgs-sweep --help lists all "),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_typo_is_one_line_with_what_was_meant(
    sweep_here: RunCommand, tmp_path: Path, words: list[str], message: str
) -> None:
    for name in ("garden", "my photos"):
        (tmp_path / name).mkdir()
    code, out, err = sweep_here(*words, "dry_run=true")
    assert (code, out) == (1, "")
    assert err.startswith("xrgs-sweep: ")
    assert message in err
    assert "HYDRA_FULL_ERROR" not in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("train.steps=100,", "train.steps=100"),
        ("train.steps=100,,200", "train.steps=100,200"),
        ("+ablation=[a,,b]", "'+ablation=[a,b]'"),
        ("train.steps==100", "train.steps=100"),
        ("train.steps=choice(100", "'train.steps=choice(100)'"),
        ("components.consistency={weight:0.3", "'components.consistency={weight:0.3}'"),
        ("train.steps=(100,200)", "train.steps=100,200"),
        ("train.steps=choice(range(100,300,100))", "'train.steps=range(100,300,100)'"),
        ("seed=sort(choice(range(3)))", "'seed=sort(range(3))'"),
        ("+ablation=[a,b", "'+ablation=[a,b]'"),
        ("+ablation=a,b]", "'+ablation=[a,b]'"),
        ("+ablation=(a,b", "+ablation=a,b"),
        ("+ablation=a,b)", "+ablation=a,b"),
        ("train.steps=100,200]", "train.steps=100,200"),
    ],
)
def test_an_override_that_hydra_s_grammar_refuses_is_answered_with_the_words_to_type(
    word: str, meant: str
) -> None:
    if word.startswith("+ablation=") and ",," not in word:
        assert with_quotes([word]) == [word]  # no files whose names have brackets, as `[a` and `b`
    with pytest.raises(XrgsError) as refused, explained():
        expand([word])
    assert str(refused.value).startswith(f"{word}: ")
    assert str(refused.value).endswith(f"; write {meant}")
    assert expand(shlex.split(meant))


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("seed=0-3", "seed=0,1,2,3"),
        ("seed=0-3", "'seed=range(0,4)'"),
        ("seed=0..2", "seed=0,1,2"),
        ("seed=0:2", "seed=0,1,2"),
        ("seed=0–2", "seed=0,1,2"),
        ("seed=0 to 2", "seed=0,1,2"),
        ("seed=[0-2]", "seed=0,1,2"),
        ("seed=0-2,7", "seed=0,1,2,7"),
        ("seed=0 1 2", "seed=0,1,2"),
        ("seed=0;1;2", "seed=0,1,2"),
        ("seed=[0,1,2]", "seed=0,1,2"),
        ("seed=(0,1,2)", "seed=0,1,2"),
        ("variant.hr_fraction=0.1 0.2", "variant.hr_fraction=0.1,0.2"),
        ("train.steps=100-30000", "'train.steps=range(100,END,STEP)'"),
        ("variant.hr_fraction=0.1-0.3", "'variant.hr_fraction=range(0.1,END,STEP)'"),
    ],
)
def test_numbers_in_a_notation_of_people_are_answered_with_the_words_to_type(
    word: str, meant: str
) -> None:
    """The words to type have the numbers that a reader of the notation would list."""
    with pytest.raises(XrgsError) as refused:
        with_quotes([word])
    assert str(refused.value).startswith(f"{word}: ")
    assert meant in str(refused.value)
    if "END" not in meant:
        (typed,) = with_quotes(shlex.split(meant))
        read = [spec.shared[0].partition("=")[2] for spec in expand([typed])]
        assert read == re.findall(
            r"[\d.]+", "0 1 2 3" if "range" in meant else meant.partition("=")[2]
        )


@pytest.mark.slow
def test_words_that_a_later_one_replaces_are_said(sweep_here: RunCommand) -> None:
    """As bash makes them of `seed={0..2}`; a word that is only repeated is no mistake."""
    said = "seed is given 3 times, and seed=2 replaces the others; for all of them write seed=0,1,2"
    words = ["seed=0", "scene=motorcycle", "seed=1", "scene=motorcycle", "seed=2", "seed=2"]
    assert replaced_words(words[:5]) == [said]
    assert replaced_words([*words[:2], words[3], "--config-dir=a", "--config-dir=b"]) == []
    assert replaced_words(["+ablation=a", "ablation=[b]"]) == [
        "ablation is given 2 times, and ablation=[b] replaces the others; for all of them write"
        " 'ablation=a,[b]'"
    ]
    code, out, err = sweep_here(*words[:5], "variant.test_every=0", "dry_run=true")
    assert (code, out) == (0, "")
    assert said in err.splitlines()
    assert err.count(" / seed ") == err.count(" / seed 2") == 1


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("sédé=3", "there is no such key"),
        ("a b=3", "there is no such key"),
        ("train.stebs!=3", "there is no such key; did you mean train.steps or"),
        ("train.steps=100;200", "several values are written as train.steps=1,2,3 or"),
        ("seed=foo(1,2)", "can't be read"),
        ("seed=range(a,b)", "can't be read"),
        ("scene.name='a", "can't be read"),
        ("train.steps=range(100,30000)", "this range has 29900 values, 10000 can be: give a step"),
        ("seed=range(0,3,0)", "the step of a range must not be 0"),
        ("seed=choice()", "empty choice is not legal"),
    ],
)
def test_no_message_has_the_words_of_a_parser(word: str, said: str) -> None:
    with pytest.raises(XrgsError, match=re.escape(said)) as refused, explained():
        expand([word])
    assert str(refused.value).startswith(f"{word}: ")
    assert not re.search("expecting|viable|argument|Exception|Error|Sweep", str(refused.value))


@pytest.mark.parametrize(
    ("word", "read"),
    [
        ("train.steps=3e3", "train.steps=3000"),
        ("seed=9007199254740993,9223372036854775807", "seed=9007199254740993,9223372036854775807"),
        ("train.steps=1e2,2.0,5", "train.steps=100,2,5"),
        ("variant.long_side=504.0", "variant.long_side=504"),
        ("train.steps=1.5", "train.steps=1.5"),  # refused by its type
        ("train.validation=3e-1", "train.validation=3e-1"),  # no whole number
        ("scene.path=1e3", "scene.path='1e3'"),
        *((word, word) for word in ("seed=3", "seed=-3", "seed=${variant.seed}", "seed=0,1")),
        ("train.optimizer.x=1e-3", "train.optimizer.x=1e-3"),
    ],
)
def test_a_whole_number_may_be_written_in_any_way(word: str, read: str) -> None:
    assert with_quotes([word]) == [read]


def test_a_setting_of_a_plugin_without_a_plus_is_told_it(
    compose: Callable[..., config.Conf],
) -> None:
    word = "components.plugins.fade.weight=0.1"
    said = re.escape("has a + before it: +components.plugins.fade")
    with pytest.raises(XrgsError, match=said), explained():
        compose(word)
