"""`scenes/` of a store with other pictures than those that were rendered."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from xrgs import composing
from xrgs.capture import scenes
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store

LONG_SIDE = 64


def resolve(store: Path) -> None:
    conf = composing.compose("scene=procedural").scene
    conf.views = 2
    scenes.resolve(conf, Store(store).scenes, LONG_SIDE)


def contents(store: Path) -> dict[str, bytes]:
    """The rendered pictures by their paths, without folders that were set aside.

    A link or a pipe has the content of its kind.
    """
    return {
        str(file.relative_to(store)): file.read_bytes()
        if file.is_file() and not file.is_symlink()
        else b"not a regular file"
        for file in sorted(store.glob("scenes/[!.]*/*.png"))
    }


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("rendered") / "store"
    Store(store).prepare()
    resolve(store)
    return store


def _paint_red(file: Path) -> None:
    with Image.open(file) as image:
        size = image.size
    Image.new("RGB", size, "red").save(file)


def _flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def _truncate(file: Path) -> None:
    os.truncate(file, 100)


def _link(file: Path) -> None:
    outside = file.parents[3] / "outside.png"
    file.rename(outside)
    _paint_red(outside)
    file.symlink_to(outside)


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _link_the_folder(file: Path) -> None:
    outside = file.parents[3] / "outside"
    file.parent.rename(outside)
    _paint_red(outside / file.name)
    file.parent.symlink_to(outside)


@pytest.mark.parametrize(
    "change", [_paint_red, _flip_a_bit, _truncate, _link, _pipe, _link_the_folder, Path.unlink]
)
def test_pictures_that_were_not_rendered_are_not_taken(
    rendered: Path, tmp_path: Path, change: Callable[[Path], None]
) -> None:
    store = tmp_path / "store"
    shutil.copytree(rendered, store)
    expected = contents(store)
    assert len(expected) == 2
    change(next(store.glob("scenes/[!.]*/*.png")))
    refused = ""
    try:
        resolve(store)
    except XrgsError as error:
        refused = str(error)
    assert "scenes" in refused or contents(store) == expected
