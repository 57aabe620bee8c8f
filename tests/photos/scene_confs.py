"""Configs of scenes, with the baseline's values for all else."""

from __future__ import annotations

from dataclasses import replace

from tests.conftest import composed
from xrgs.config import SceneConf


def scene_conf(kind: str, path: object = None, *, name: str = "", views: int = 24) -> SceneConf:
    file = None if path is None else str(path)
    return replace(composed().scene, kind=kind, path=file, name=name, views=views)
