"""Configs of scenes, with the baseline's values for all else."""

from __future__ import annotations

from tests.conftest import composed
from xrgs.config import SceneConf, VariantConf


def scene_conf(kind: str, path: object = None, *, name: str = "", views: int = 24) -> SceneConf:
    file, black = None if path is None else str(path), (0.0, 0.0, 0.0)
    others = {"masks": None, "alpha": "composite", "background": black}
    return SceneConf(kind=kind, path=file, name=name, views=views, **others)


def whole_sizes() -> VariantConf:
    """Photographs of their own size, and LR views of half of it."""
    return composed("variant.long_side=0", "variant.factor=2").variant
