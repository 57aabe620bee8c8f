"""Rendered photographs that are kept: verified before each use, and never silently others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from xrgs.errors import UnreadableError
from xrgs.photos import scenes
from xrgs.photos.scenes import rendered

VIEWS = ("a", "b")


class Renderer:
    """Writes small files in the place of images, and counts how often."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, work: Path) -> None:
        self.count += 1
        for view in VIEWS:
            (work / f"{view}.png").write_text(f"the image {view}")


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """The folder of a rendered scene."""
    home = tmp_path / "scenes/0123456789abcdef"
    rendered.provide(home, VIEWS, Renderer())
    return home


def test_an_intact_scene_is_rendered_once(home: Path) -> None:
    render = Renderer()
    rendered.provide(home, VIEWS, render)
    assert render.count == 0
    assert rendered.verify(home) == scenes.verify(home) == []
    assert json.loads((home / "scene.json").read_text())["fingerprint"] == home.name


@pytest.mark.parametrize(
    "damage",
    ["other image", "image gone", "list", "other scene", "other views"],
)
def test_a_damaged_scene_is_set_aside_and_rendered_anew(
    home: Path, damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    image, manifest = home / "b.png", home / "scene.json"
    named = "b.png" if "image" in damage else "scene.json"
    content = json.loads(manifest.read_text())
    if damage == "other image":
        image.write_text("all red")
    elif damage == "image gone":
        image.unlink()
    elif damage == "list":
        manifest.write_text(json.dumps(content | {"files": [1]}))
    elif damage == "other scene":
        manifest.write_text(json.dumps(content | {"fingerprint": "f" * 16}))
    else:
        del content["files"]["b.png"]
        manifest.write_text(json.dumps(content))
    (home / "mine.txt").write_text("kept")
    assert any(named in line for line in rendered.verify(home)) or damage == "other views"
    render = Renderer()
    rendered.provide(home, VIEWS, render)
    assert render.count == 1
    assert rendered.verify(home) == []
    aside = tmp_path / "scenes" / ".0123456789abcdef.aside-1"
    assert (aside / "mine.txt").read_text() == "kept"
    assert named in caplog.text
    assert aside.name in caplog.text


@pytest.mark.parametrize("name", ["b.png", "scene.json"])
def test_a_scene_that_cant_be_read_now_is_not_rendered_over(
    home: Path,
    name: str,
    unreadable: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unreadable(name)
    render = Renderer()
    with pytest.raises(UnreadableError, match=f"{name}: Input/output error"):
        rendered.provide(home, VIEWS, render)
    assert f"{name}: Input/output error" in rendered.verify(home)[0]
    monkeypatch.undo()
    rendered.provide(home, VIEWS, render)
    assert render.count == 0


def test_an_interrupted_rendering_leaves_no_scene(tmp_path: Path) -> None:
    home = tmp_path / "scenes/0123456789abcdef"
    leftover = tmp_path / "scenes" / ".0123456789abcdef.rendering" / "a.png"
    leftover.parent.mkdir(parents=True)
    leftover.write_text("half")

    def fail(work: Path) -> None:
        assert not list(work.iterdir())
        (work / "a.png").write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rendered.provide(home, VIEWS, fail)
    assert not list((tmp_path / "scenes").iterdir())
