"""Configs of scenes, with the baseline's values for all else."""

from __future__ import annotations

from tests.conftest import composed
from xrgs.config import SceneConf, VariantConf


def scene_conf(kind: str, path: object = None, *, name: str = "", views: int = 24) -> SceneConf:
    return SceneConf(
        kind=kind,
        path=None if path is None else str(path),
        name=name,
        views=views,
        masks=None,
        alpha="composite",
        background=(0.0, 0.0, 0.0),
    )


def whole_sizes() -> VariantConf:
    """Photographs of their own size, and LR views of half of it."""
    return composed("variant.long_side=0", "variant.factor=2").variant
