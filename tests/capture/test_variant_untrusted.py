"""Forged variants: they are refused, and nothing outside their folder is read or written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from xrgs.capture import variant
from xrgs.capture.variant import CorruptVariant
from xrgs.capture.views import Variant, View


@pytest.fixture
def forge(tmp_path: Path) -> Callable[..., Path]:
    """(changes of its first view, changes of the variant) -> the folder of a variant."""

    def freeze(view: dict[str, Any] | None = None, **changes: Any) -> Path:
        work = tmp_path / "work"
        (work / "images/test").mkdir(parents=True)
        views = []
        for name in ("a", "b"):
            file = work / f"images/test/{name}.png"
            Image.new("RGB", (4, 3)).save(file)
            views.append(View(name, file, "test", "HR", 4, 3, np.eye(3), np.eye(4), 1.0))
        views[0] = replace(views[0], **(view or {}))
        made = Variant("", work, "scene", 5, True, tuple(views), np.ones((2, 3)), _COLORS, {})
        return variant._freeze(replace(made, **changes), "key", work, tmp_path).path

    return freeze


_COLORS = np.zeros((2, 3), np.uint8)


def test_a_variant_with_right_values_is_loaded(forge: Callable[..., Path]) -> None:
    assert [view.name for view in variant.load(forge()).views] == ["a", "b"]


@pytest.mark.parametrize(
    ("view", "changes"),
    [
        ({"name": "../../../evil"}, {}),
        ({"name": "/evil"}, {}),
        ({"name": "a\nb"}, {}),
        ({"name": "b"}, {}),
        ({"name": 1}, {}),
        ({"split": "../x"}, {}),
        ({"tag": "x"}, {}),
        ({"width": -4}, {}),
        ({"height": "3"}, {}),
        ({"rho": float("nan")}, {}),
        ({"K": np.full((3, 3), np.inf)}, {}),
        ({"viewmat": np.eye(3)}, {}),
        ({}, {"points": np.full((2, 3), np.nan)}),
        ({}, {"colors": np.zeros((3, 3), np.uint8)}),
        ({}, {"factor": 0}),
        ({}, {"scene": ["x"]}),
        ({}, {"report": []}),
    ],
)
def test_a_wrong_value_is_refused(
    forge: Callable[..., Path], view: dict[str, Any], changes: dict[str, Any]
) -> None:
    with pytest.raises(CorruptVariant):
        forge(view, **changes)


def test_an_image_outside_the_folder_is_refused(forge: Callable[..., Path], tmp_path: Path) -> None:
    folder = forge()
    content = json.loads((folder / "variant.json").read_text())
    picture, secret = folder / "images/test/a.png", tmp_path / "secret.png"
    picture.rename(secret)
    picture.symlink_to(secret)
    with pytest.raises(CorruptVariant, match=r"a\.png: it has changed since it was frozen"):
        variant.load(folder)
    hashed = content["files"].pop("images/test/a.png")
    for path in ("../secret.png", str(secret)):
        for files in (content["files"] | {path: hashed}, content["files"]):
            forged = content | {"files": files}
            forged["views"][0]["file"] = path
            forged["id"] = variant._id(forged)
            (folder / "variant.json").write_text(json.dumps(forged))
            with pytest.raises(CorruptVariant, match=r"secret|not a complete"):
                variant.load(folder)


def test_a_lock_that_is_a_link_empties_nothing(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / ".key.lock").symlink_to(precious)
    with pytest.raises(OSError, match="key"), variant._lock(tmp_path / ".key.lock"):
        pass
    assert precious.read_text() == "mine"
