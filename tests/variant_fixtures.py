"""Configs of small variants, and variants that are built once for all tests."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.photos.scene_confs import scene_conf
from xrgs.config import Conf, SceneConf, SfmConf, VariantConf
from xrgs.mixture import variant
from xrgs.mixture.views import Variant


@pytest.fixture
def unreadable(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """(end of a path, number of an error) -> only files with that end can't be read from now on.

    The error is that of a disk that fails, if none is given; 0 makes all files readable again.
    """
    opened, opened_io = os.open, io.open

    def fail(end: str, number: int = errno.EIO) -> None:
        def failing(real: Callable[..., Any]) -> Callable[..., Any]:
            def instead(path: Any, *args: Any, **options: Any) -> Any:
                if number and isinstance(path, (str, Path)) and str(path).endswith(end):
                    raise OSError(number, os.strerror(number), str(path))
                return real(path, *args, **options)

            return instead

        monkeypatch.setattr(os, "open", failing(opened))
        monkeypatch.setattr(io, "open", failing(opened_io))

    return fail


@pytest.fixture
def disk_events(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is synced and named from now on, in its order: `sync NAME` and `rename OLD to NEW`.

    A file that is written under a temporary name gets its own by `name NEW`.
    """
    events: list[str] = []
    sync, rename, replace = os.fsync, os.rename, os.replace

    def synced(descriptor: int) -> None:
        events.append("sync " + Path(f"/proc/self/fd/{descriptor}").readlink().name)
        sync(descriptor)

    def renamed(old: str, new: str, **folders: int) -> None:
        events.append(f"rename {Path(old).name} to {Path(new).name}")
        rename(old, new, **folders)

    def replaced(old: str, new: str, **folders: int) -> None:
        events.append(f"name {Path(new).name}")
        replace(old, new, **folders)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "rename", renamed)
    monkeypatch.setattr(os, "replace", replaced)
    return events


@pytest.fixture(scope="session")
def configured(compose: Callable[..., Conf]) -> Callable[..., VariantConf]:
    """(**changes; sfm=changes of SfM) -> the baseline's variant config with these changes.

    SfM of the undegraded photographs is left out.
    """
    baseline = compose("variant.sfm.reference=false").variant

    def changed(sfm: dict[str, Any] | None = None, **changes: Any) -> VariantConf:
        return replace(baseline, sfm=replace(baseline.sfm, **(sfm or {})), **changes)

    return changed


@pytest.fixture(scope="session")
def sfm_conf(configured: Callable[..., VariantConf]) -> SfmConf:
    """The baseline's config of SfM."""
    return configured().sfm


@pytest.fixture(scope="session")
def procedural_scene() -> SceneConf:
    """The embedded multi-view scene, 12 views."""
    return scene_conf("procedural", name="procedural", views=12)


@pytest.fixture(scope="session")
def stereo_scene() -> SceneConf:
    """The embedded stereo pair."""
    return scene_conf("motorcycle", name="motorcycle")


@pytest.fixture(scope="session")
def small_conf(configured: Callable[..., VariantConf]) -> Callable[..., VariantConf]:
    """(scene, **changes) -> a config of small views; of the stereo pair no view is held out."""

    def conf(scene: SceneConf, **changes: Any) -> VariantConf:
        small: dict[str, Any] = {"long_side": 252}
        if scene.kind == "motorcycle":
            small = {"long_side": 185, "test_every": 0, "min_hr": 1}
        return configured(**small | changes)

    return conf


@pytest.fixture(scope="session")
def build_in(small_conf: Callable[..., VariantConf]) -> Callable[..., Variant]:
    """(store, scene, **changes) -> the variant of `small_conf` with these changes, in the store."""

    def build(store: Path, scene: SceneConf, **changes: Any) -> Variant:
        conf = small_conf(scene, **changes)
        store.mkdir(exist_ok=True)
        return variant.build(scene, conf, store / "variants", store / "scenes")

    return build


@pytest.fixture(scope="session")
def shared_store(made_once: Callable[..., Path]) -> Path:
    """A store for variants that no test changes; all workers have it, and build each once."""
    return made_once("store", lambda _: None)


@pytest.fixture(scope="session")
def procedural_variant(
    build_in: Callable[..., Variant], shared_store: Path, procedural_scene: SceneConf
) -> Variant:
    """The embedded scene with the default settings, at 252 px. Building it takes seconds."""
    return build_in(shared_store, procedural_scene)


@pytest.fixture(scope="session")
def stereo_variant(
    build_in: Callable[..., Variant], shared_store: Path, stereo_scene: SceneConf
) -> Variant:
    """The stereo pair at 185 px, one view of it LR."""
    return build_in(shared_store, stereo_scene)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """An empty store for the variants of one test; it does not exist."""
    return tmp_path / "store"


@pytest.fixture
def build(build_in: Callable[..., Variant], store: Path) -> Callable[..., Variant]:
    """(scene, **changes) -> as `build_in`, in `store`."""
    return partial(build_in, store)
