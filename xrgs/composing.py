"""Makes and checks configs from a command line, from nested dicts, and from the file of a cell.

Hydra and OmegaConf are imported only to compose a config, so that the process of a cell, which
reads its config from a file, does not need them.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import is_dataclass
from functools import cache, reduce
from operator import getitem
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import msgspec

from xrgs.config import CONF_DIR, PATHS, ComponentsConf, Conf, is_on, known_keys, types_of
from xrgs.errors import XrgsError, did_you_mean
from xrgs.safeio.paths import user_path
from xrgs.safeio.records import read_struct
from xrgs.splat.settings import NOMINAL_STEPS, outside_limits

if TYPE_CHECKING:
    from omegaconf import DictConfig

#: The start of an interpolation and the backslashes before it; an odd number escapes it.
_INTERPOLATION = re.compile(r"(\\*)\$\{")
#: The key at the end of msgspec's error messages: "... - at `$.train.steps`".
_AT = re.compile(r" - at `\$\.?(.*)`$")
#: OmegaConf's message if null is given for a key that takes a value.
_NOT_NULL = re.compile(r"field '([^']+)' is not Optional")
#: Placeholder in `conf/config.yaml` for a value that the files of `conf/scene/` set.
_OPEN = "???"
_HYDRA_LOCK = threading.Lock()
#: torch holds whole numbers below it, and from its negative on.
INT64_LIMIT = 2**63


def compose(*overrides: str) -> Conf:
    """Compose the config of a cell, as `xrgs-sweep` does from its command line.

    Args:
        overrides: Hydra overrides without axes, as `preset=smoke`, `+ablation=consistency` or
            `train.steps=100`. Without overrides, the config is the baseline of `conf/config.yaml`.

    Raises:
        HydraException: An override is malformed, or its key or file does not exist.
        OmegaConfBaseException: A value is missing or of the wrong type; the message names its key.
        XrgsError: A value is out of range; the message names its key.

    Examples:
        >>> compose("preset=smoke", "train.steps=100").train.steps
        100
    """
    with _own_hydra() as hydra:
        return to_conf(hydra.compose("config", list(overrides)))


@contextmanager
def _own_hydra() -> Iterator[ModuleType]:
    """Initialise Hydra with the config of this package, and afterwards restore the caller's state.

    Hydra, its `version_base` and its job name are global in a process. A notebook or a function of
    `@hydra.main` may be using them, and several threads may compose concurrently.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.utils import JobRuntime
    from hydra.version import VersionBase

    with _HYDRA_LOCK:
        base, job = VersionBase.instance(), JobRuntime.instance()
        callers = (GlobalHydra.instance().hydra, base.version_base, job.conf)
        GlobalHydra.instance().clear()
        job.conf = deepcopy(job.conf)
        try:
            with hydra.initialize_config_dir(str(CONF_DIR), version_base="1.3"):
                yield hydra
        finally:
            GlobalHydra.instance().hydra, base.version_base, job.conf = callers


def to_conf(cfg: DictConfig) -> Conf:
    """Convert a config from Hydra to a `Conf`, and check ranges and choices.

    Returns:
        The config, with resolved interpolations.

    Raises:
        OmegaConfBaseException: A value is missing; the message names its key.
        XrgsError: A value is out of range or of the wrong type, or a key is unknown; the message
            names the key.
    """
    from omegaconf import OmegaConf

    def plain(name: str) -> Any:
        value = cfg[name]
        if not OmegaConf.is_config(value):
            return value
        return OmegaConf.to_container(value, resolve=True, throw_on_missing=True)

    values = {name: plain(name) for name in map(str, cfg) if name != "hydra"}
    for key, value in dotted(values):
        if isinstance(value, int) and not -INT64_LIMIT <= value < INT64_LIMIT:
            raise XrgsError(f"{key}={value}: must be below 2^63 = {INT64_LIMIT}")
    conf = from_dict(values)
    for key in PATHS:
        *groups, name = key.split(".")
        group = reduce(getattr, groups, conf)
        path = getattr(group, name)
        if path is not None and path.startswith("~"):
            setattr(group, name, str(user_path(path)))
    _check_limits(conf)
    for key, value in dotted(values):
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, float) and not math.isfinite(number):  # JSON has no such number
                raise XrgsError(f"{key}={value}: must be finite")
    _check_strategy(conf)
    _check_views(conf)
    return conf


def following_seed(cfg: DictConfig) -> dict[str, str]:
    """Return the texts that interpolate `seed`, by their keys, as `variant.seed=${seed}` does."""
    from omegaconf import OmegaConf

    values = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=False))
    values.pop("hydra", None)
    texts = {key: str(value) for key, value in dotted(values)}
    return {key: text for key, text in texts.items() if "${" in text and "seed" in text}


def dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested dicts with their dotted keys, as `splat.densify.every`."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _value(conf: Conf, key: str) -> Any:
    return reduce(getattr, key.split("."), conf)


def _check_limits(group: Any, path: str = "") -> None:
    """Raise `XrgsError` for a value outside its limits; the message names its key.

    A component that is off is left out: its keys may depend on others, as on `splat.densify.stop`.
    """
    for message in outside_limits(group, path):
        raise XrgsError(message)
    for name, inner in vars(group).items():
        if is_dataclass(inner) and (is_on(inner) or not isinstance(group, ComponentsConf)):
            _check_limits(inner, f"{path}{name}.")


def _check_strategy(conf: Conf) -> None:
    """Raise `XrgsError` for a setting that the strategy of densification ignores."""
    densify = conf.splat.densify
    if conf.splat.strategy == "default":
        if densify.noise:
            raise XrgsError(
                f"splat.densify.noise={densify.noise}: must be 0 with splat.strategy=default, which"
                " adds no noise"
            )
    elif densify.budget == 0:
        raise XrgsError(
            "splat.densify.budget=0: must be above 0 with splat.strategy=mcmc, which adds Gaussians"
            " up to it; +ablation=mcmc has a budget"
        )
    else:
        for key, accepted in (("splat.densify.split", "random"), ("splat.raster.absgrad", False)):
            if (value := _value(conf, key)) != accepted:
                raise XrgsError(
                    f"{key}={value}: must be {accepted} with splat.strategy=mcmc, which splits"
                    " nothing and reads no image-plane gradient"
                )


#: Kinds of scenes whose views are all there are, and what to do for fewer.
_ALL_VIEWS = {
    "folder": "all photographs of the folder are taken; for fewer, name another folder",
    "motorcycle": "the scene has two views",
}


def _check_views(conf: Conf) -> None:
    """Raise `XrgsError` for a number of views that the kind of scene ignores."""
    kind, views = conf.scene.kind, conf.scene.views
    if kind in _ALL_VIEWS and views != _baseline()["scene"]["views"]:
        raise XrgsError(
            f"scene.views={views}: is for videos and the embedded scene, and not read with"
            f" scene.kind={kind}: {_ALL_VIEWS[kind]}"
        )


#: Former group of `components`, now a plugin of the same name -> the key that switched it on, and
#: the key's value if it was off.
_FORMER_GROUPS = {
    "error_score": ("of", "nothing"),
    "multiview_score": ("views", 0),
    "noise_weighting": ("floor", 1.0),
    "skip_backward": ("share", 1.0),
}
#: All ablations of the package `examples/arms`.
ARMS = frozenset({*_FORMER_GROUPS, "mip_off_late", "near_gradients", "unweighted_consistency"})


def from_dict(values: Any) -> Conf:
    """Convert the nested dicts of `dataclasses.asdict` back to a config.

    Interpolations are not resolved: a path may contain `${`, and a file of unknown origin must not
    read this process's environment.

    Raises:
        XrgsError: A key is unknown or missing, or a value is of the wrong type; the message names
            the key.
    """
    for _, _, key in _missing(values, Conf):
        raise XrgsError(f"{key}: is missing")
    return _complete(values)


def _complete(values: Any) -> Conf:
    """Convert nested dicts that have every key and no other; raises as `from_dict`."""
    try:
        conf = msgspec.convert(values, Conf)
    except msgspec.ValidationError as error:
        message = str(error)
        if path := _AT.search(message):
            message = f"{path[1]}: {message[: path.start()]}"
        raise XrgsError(message) from error
    for name, settings in conf.components.plugins.items():
        if not isinstance(settings, dict):  # the plugin checks its settings
            key = f"components.plugins.{name}"
            raise XrgsError(
                f"{key}={settings}: must be a mapping of settings, e.g. +{key}.weight=0.1"
            )
    return conf


def _missing(values: Any, schema: Any, path: str = "") -> Iterator[tuple[Any, str, str]]:
    """Yield each key that is missing in nested dicts: the dict, the name in it, the dotted key.

    msgspec would use the defaults of `xrgs.splat.settings` for missing keys, and ignore unknown
    keys; for unknown keys this raises `XrgsError`.
    """
    if not isinstance(values, dict):
        return  # msgspec refuses it
    types = types_of(schema)
    for name in values:
        if name not in types:
            key = f"{path}{name}"
            raise XrgsError(f"{key}: there is no such key{did_you_mean(key, known_keys())}")
    for name, kind in types.items():
        if is_dataclass(kind):
            yield from _missing(values.setdefault(name, {}), kind, f"{path}{name}.")
        elif name not in values:
            yield values, name, f"{path}{name}"


def escape_interpolations(text: str) -> str:
    r"""Write each `${` as `\${`, with twice the backslashes before it, so that it is no key."""
    return _INTERPOLATION.sub(lambda match: 2 * match[1] + r"\${", text)


def from_file(file: Path) -> tuple[Conf, dict[str, Any]]:
    """Read the config in a cell's folder, a JSON file.

    Keys that were added after the file was written get their value from `conf/config.yaml`, which
    means "off". Settings of components that have moved to `examples/arms` become those of the
    plugin, if the component was on.

    Returns:
        The config, and missing key -> value that was inserted.

    Raises:
        XrgsError: The file can't be read, or has another schema; the message names file and key.
    """
    values = read_struct(file, Any)
    added = {}
    try:
        _move_to_plugins(values)
        for group, name, key in _missing(values, Conf):
            value = reduce(getitem, key.split("."), _baseline())
            if value == _OPEN:
                raise XrgsError(f"{key}: is missing")
            group[name] = added[key] = deepcopy(value)
        return _complete(values), added
    except XrgsError as error:
        raise XrgsError(f"{file}: {error} (another version of xrgs may have written it)") from error


def _move_to_plugins(values: Any) -> None:
    """Move settings of former components to their plugins, in place; drop those that are off."""
    components = values.get("components") if isinstance(values, dict) else None
    if not isinstance(components, dict):
        return  # `_missing` refuses it
    moved = {}
    for name, (key, off) in _FORMER_GROUPS.items():
        if isinstance(settings := components.get(name), dict):
            del components[name]
            if settings.get(key, off) != off:
                moved[name] = settings
    floaters = components.get("floaters")
    if isinstance(floaters, dict) and (share := floaters.pop("gradient_share", 0)):
        moved["near_gradients"] = {"share": share}
    if isinstance(mip := components.get("mip"), dict):
        until = mip.pop("until", NOMINAL_STEPS)
        if until != NOMINAL_STEPS and mip.get("variance"):
            moved["mip_off_late"] = mip | {"until": until}
            mip["variance"] = 0.0
    if moved and isinstance(plugins := components.setdefault("plugins", {}), dict):
        plugins.update(moved)


@cache
def _baseline() -> Any:
    """Return the values of `conf/config.yaml` as nested dicts."""
    from omegaconf import OmegaConf

    conf = cast("DictConfig", OmegaConf.load(CONF_DIR / "config.yaml"))
    return OmegaConf.to_container(OmegaConf.masked_copy(conf, list(types_of(Conf))), resolve=True)


def error_line(error: Exception) -> str:
    """Return the first line of an error's message, with the config's key.

    Returns:
        One line, prefixed with the key if the message does not contain it.
    """
    line, key = str(error).splitlines()[0], getattr(error, "full_key", None)
    line = _NOT_NULL.sub(r"\1: takes a value, and not null", line)
    return line if not key or key in line else f"{key}: {line}"
