"""Rendered photographs that are kept: verified before each use, and never silently others."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from xrgs.capture import scenes
from xrgs.capture.scenes import rendered
from xrgs.errors import UnreadableError
from xrgs.safeio.confined import ConfinedPath

IMAGES = ("a.png", "b.png")


class Renderer:
    """Writes small files in the place of images, and counts how often."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, work: ConfinedPath) -> None:
        self.count += 1
        for name in IMAGES:
            (work.path / name).write_text(f"the image {name}")


@pytest.fixture
def home(tmp_path: Path) -> ConfinedPath:
    """The folder of a rendered scene."""
    home = ConfinedPath(tmp_path) / "scenes/0123456789abcdef"
    rendered.provide(home, IMAGES, Renderer())
    return home


def test_an_intact_scene_is_rendered_once(home: ConfinedPath) -> None:
    render = Renderer()
    rendered.provide(home, IMAGES, render)
    assert render.count == 0
    assert rendered.verify(home) == scenes.verify(home.path) == []
    assert json.loads((home.path / "scene.json").read_text())["fingerprint"] == home.name


@pytest.mark.parametrize(
    "damage",
    ["other image", "image gone", "pipe", "link", "no list", "list", "other scene", "other views"],
)
def test_a_damaged_scene_is_set_aside_and_rendered_anew(
    home: ConfinedPath, damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    image, manifest = home.path / "b.png", home.path / "scene.json"
    named = "b.png" if damage in {"other image", "image gone", "pipe", "link"} else "scene.json"
    content = json.loads(manifest.read_text())
    if damage == "other image":
        image.write_text("all red")
    elif damage in {"image gone", "pipe", "link"}:
        image.unlink()
        if damage == "pipe":
            os.mkfifo(image)
        if damage == "link":
            (tmp_path / "elsewhere").write_text("the image b.png")
            image.symlink_to(tmp_path / "elsewhere")
    elif damage == "no list":
        manifest.unlink()
    elif damage == "list":
        manifest.write_text(json.dumps(content | {"files": [1]}))
    elif damage == "other scene":
        manifest.write_text(json.dumps(content | {"fingerprint": "f" * 16}))
    else:
        del content["files"]["b.png"]
        manifest.write_text(json.dumps(content))
    (home.path / "mine.txt").write_text("kept")
    assert any(named in line for line in rendered.verify(home)) or damage == "other views"
    render = Renderer()
    rendered.provide(home, IMAGES, render)
    assert render.count == 1
    assert rendered.verify(home) == []
    aside = tmp_path / "scenes" / ".0123456789abcdef.aside-1"
    assert (aside / "mine.txt").read_text() == "kept"
    assert named in caplog.text
    assert aside.name in caplog.text


@pytest.mark.parametrize("name", ["b.png", "scene.json"])
def test_a_scene_that_cant_be_read_now_is_not_rendered_over(
    home: ConfinedPath, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = ConfinedPath._open_regular

    def fails(self: ConfinedPath, flags: int) -> int:
        if self.name == name:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(self))
        return opened(self, flags)

    monkeypatch.setattr(ConfinedPath, "_open_regular", fails)
    render = Renderer()
    with pytest.raises(UnreadableError, match=f"{name}: Stale file handle"):
        rendered.provide(home, IMAGES, render)
    assert f"{name}: Stale file handle" in rendered.verify(home)[0]
    monkeypatch.undo()
    rendered.provide(home, IMAGES, render)
    assert render.count == 0


def test_verifying_names_every_file(home: ConfinedPath) -> None:
    (home.path / "a.png").unlink()
    (home.path / "b.png").write_text("changed")
    (home.path / "c.png").write_text("new")
    assert rendered.verify(home) == [
        f"{home}/a.png: No such file or directory",
        f"{home}/b.png: it has changed since it was written",
        f"{home}/c.png: it does not belong there",
    ]


def test_an_interrupted_rendering_leaves_no_scene(tmp_path: Path) -> None:
    home = ConfinedPath(tmp_path) / "scenes/0123456789abcdef"
    leftover = tmp_path / "scenes" / ".0123456789abcdef.rendering" / "a.png"
    leftover.parent.mkdir(parents=True)
    leftover.write_text("half")

    def fail(work: ConfinedPath) -> None:
        assert work.names() == []
        (work.path / "a.png").write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rendered.provide(home, IMAGES, fail)
    assert [path.name for path in (tmp_path / "scenes").iterdir()] == [".0123456789abcdef.lock"]
