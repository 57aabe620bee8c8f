"""What a word of the command line stands for: a cell of a store, or a .ply file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.cli.store import Filter
from xrgs.errors import StoreError, XrgsError
from xrgs.formats.files import save_gaussians
from xrgs.formats.ply import save_ply
from xrgs.splat.settings import RasterSettings
from xrgs.store.attempts import begin_attempt
from xrgs.store.schema import RecordedCell
from xrgs.store.store import Store
from xrgs.viewer import models
from xrgs.viewer.models import Model


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A store with the finished cells abc1 and abd2, and the failed one abd3."""
    made = Store(tmp_path / "s")
    made.prepare()
    for cell_id in ("abc1", "abd2", "abd3"):
        cell = made.cell(cell_id)
        cell.path.mkdir()
        begin_attempt(cell)
        if cell_id == "abd3":
            cell.fail("out of memory")
        else:
            (cell.path / "scores.csv").write_text("view\na\n")
            cell.finish(["a"], {})
    return made


def recorded(store: Store, **scenes: str) -> str:
    """Record the scenes of cells, by the cells' ids."""
    rows = [
        RecordedCell(cell_id, "plus", "", scene, 0, 0, None, None)
        for cell_id, scene in scenes.items()
    ]
    return store.write_sweep(["x"], rows)


def test_a_cell_is_found_by_its_scene_where_one_is_done(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = recorded(store, abc1="garden", abd2="my bike", abd3="garden")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos/garden/images").mkdir(parents=True)
    for word in ("garden", "photos/garden", "photos/garden/", "photos/garden/images"):
        assert store.find_cell(word).id == "abc1"
    assert store.find_cell("my bike").id == "abd2"
    (store.cell("abd2").path / "identity.json").write_text("{}")
    assert Store("gone").find_cell(str(store.cell("abd2").path)).id == "abd2"
    assert store.find_folder("garden") == store.cell("abc1").path
    assert [row.id for row in Filter(("garden",), store=store.path).chosen()[1]] == ["abc1"]
    for word in (sweep, sweep[:6], "my bike", "photos/garden"):
        assert store.find_sweep(word) == sweep
    with pytest.raises(StoreError, match=r"^house: no sweeps have such an id"):
        store.find_sweep("house")


def test_a_word_for_several_cells_names_them(store: Store) -> None:
    recorded(store, abc1="garden", abd2="garden")
    for find in (store.find_cell, store.find_folder):
        with pytest.raises(StoreError, match=r"^garden: several .*: abc1 \(plus\), abd2 \(plus\)"):
            find("garden")
    recorded(store, abd2="abc")  # a scene like the id of another cell
    with pytest.raises(StoreError, match=r"^abc: several cells .*: abc1, abd2 \(plus\)"):
        store.find_cell("abc")
    assert store.find_cell("abc1").id == "abc1"


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("ab", "ab: several cells have such an id or scene: abc1, abd2, abd3"),
        ("../abc1", "../abc1: no cells have such an id"),
        ("abd3", "{cells}/abd3: the cell is failed, not done: out of memory"),
    ],
)
def test_a_word_that_names_no_finished_cell_is_refused(
    store: Store, word: str, message: str
) -> None:
    with pytest.raises(StoreError) as caught:
        models.load_models([word], store)
    assert str(caught.value).startswith(message.format(cells=store.cells_folder))
    assert store.find_cell("abc").id == "abc1"


def test_a_ply_file_has_the_default_settings(
    model: Callable[..., Model], store: Store, tmp_path: Path
) -> None:
    save_ply(tmp_path / "an\x1b[31m.PLY", model().gaussians)
    (loaded,) = models.load_models([str(tmp_path / "an\x1b[31m.PLY")], store)
    assert (loaded.name, loaded.views, loaded.poses) == ("an [31m.PLY", (), None)
    assert loaded.settings == RasterSettings()
    assert len(loaded.gaussians) == 40
    assert models.reference([loaded]) is None


@pytest.mark.parametrize("suffix", ["ply", "glb", "spz"])
def test_a_file_says_whether_it_is_antialiased_and_an_option_wins_with_a_word(
    model: Callable[..., Model],
    store: Store,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    suffix: str,
) -> None:
    for tagged in (True, False):
        file = tmp_path / f"a.{suffix}"
        save_gaussians(file, model().gaussians, antialiased=tagged)
        for asked in (None, True, False):
            caplog.clear()
            (loaded,) = models.load_models([str(file)], store, asked)
            wanted = tagged if asked is None else asked
            assert loaded.settings == RasterSettings(antialiased=wanted)
            said = {
                (True, False): f"a.{suffix} is antialiased; it is rendered without antialiasing",
                (False, True): f"a.{suffix} is without a word about antialiasing; it is rendered",
            }.get((tagged, wanted), "")
            assert said in caplog.text
            assert bool(caplog.text) == bool(said)


def test_a_file_in_another_format_is_named(store: Store) -> None:
    with pytest.raises(XrgsError, match=r"^a\.mp4: no cells have such an id"):  # a video's scene
        models.load_models(["a.mp4"], store)


@pytest.mark.parametrize("words", [[], ["a", "b", "c"]])
def test_one_or_two_cells_are_shown(store: Store, words: list[str]) -> None:
    with pytest.raises(XrgsError, match="give one cell or 2"):
        models.load_models(words, store)


def test_cells_of_different_variants_share_no_camera(
    model: Callable[..., Model], store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {"a": model("a"), "b": model("b")}
    made["b"] = Model(**(vars(made["b"]) | {"variant": "variant-2"}))
    monkeypatch.setattr(models, "_load", lambda word, _: made[word])
    assert [one.name for one in models.load_models(["a", "a"], store)] == ["a", "a"]
    with pytest.raises(XrgsError, match=r"different variants \(variant-1, variant-2\)"):
        models.load_models(["a", "b"], store)
