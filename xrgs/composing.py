"""Makes configs and checks them: of a command line, of nested dicts, of the file of a cell."""

from __future__ import annotations

import math
import re
from dataclasses import is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import hydra
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs.config import CONF_DIR, TRAINING_VIEWS, Conf, known_keys, register
from xrgs.errors import StoreError, XrgsError, did_you_mean
from xrgs.safeio.records import read_json
from xrgs.splat.backend import CHOICES
from xrgs.splat.settings import NOMINAL_STEPS, SPLITS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from xrgs.config import ComponentsConf

#: The start of an interpolation, with the backslashes before it: an odd number of them escapes it.
_INTERPOLATION = re.compile(r"(\\*)\$\{")
_RETRY = ("none", "failed")


def to_conf(cfg: DictConfig) -> Conf:
    """Convert a composed Hydra config to dataclasses, every value present and of its type.

    Args:
        cfg: A config composed from `conf/config.yaml`, whose defaults contain the schema.

    Returns:
        The config, its interpolations resolved.

    Raises:
        OmegaConfBaseException: A value is missing or of another type; the message names its key.
        XrgsError: A value is out of its range, or a key is unknown; the message names the key.
    """
    # The schema is in the config's own defaults, so its nodes are typed and checked already. To
    # merge it in once more takes twenty times as long, and a plan composes many configs.
    names = Conf.__dataclass_fields__
    for name in map(str, cfg):
        if name not in names and name != "hydra":
            raise XrgsError(f"{name}: there is no such key{did_you_mean(name, known_keys())}")
    conf = Conf(**{name: _as_object(cfg, name) for name in names})
    _check_known(conf, "")
    _check_plugins(conf.components)
    _check_ranges(conf)
    _check_choices(conf)
    return conf


def _check_ranges(conf: Conf) -> None:
    """Raise `XrgsError` where a number is out of its range; the message names its key."""
    least_values = (
        ("splat.optimizer.means_decay_from", conf.splat.optimizer.means_decay_from, 0),
        ("splat.optimizer.shN_every", conf.splat.optimizer.shN_every, 1),
        ("seed", conf.seed, 0),
        ("variant.seed", conf.variant.seed, 0),
        ("train.steps", conf.train.steps, 1),
        ("train.evaluate_every", conf.train.evaluate_every, 0),
        ("threads", conf.threads, 0),
        ("checkpoint_s", conf.checkpoint_s, 0),
        ("limits.minutes", conf.limits.minutes, 0),
        ("limits.memory_gb", conf.limits.memory_gb, 0),
    )
    for key, value, least in least_values:
        if not value >= least:
            raise XrgsError(f"{key}={value}: must be at least {least}")
    if not 0 <= conf.train.validation < 1:
        raise XrgsError(f"train.validation={conf.train.validation}: must be from 0 to below 1")
    if (begin := conf.splat.optimizer.means_decay_from) >= NOMINAL_STEPS:
        key = "splat.optimizer.means_decay_from"
        raise XrgsError(f"{key}={begin}: must be below {NOMINAL_STEPS}, the length of a run")
    budget = conf.splat.densify.budget
    if not (math.isfinite(budget) and budget >= 0):
        raise XrgsError(f"splat.densify.budget={budget}: must be a finite number, 0 or more")


def _check_choices(conf: Conf) -> None:
    """Raise `XrgsError` where a word is none of those that its key may have."""
    for key, value, accepted in (
        ("train.views", conf.train.views, TRAINING_VIEWS),
        ("splat.backend", conf.splat.backend, CHOICES),
        ("splat.densify.split", conf.splat.densify.split, SPLITS),
        ("retry", conf.retry, _RETRY),
    ):
        if value not in accepted:
            raise XrgsError(f"{key}={value}: must be one of {', '.join(accepted)}")


def compose(*overrides: str) -> Conf:
    """Return the config that a command line of `xrgs-sweep` would give to a cell.

    Args:
        overrides: Hydra overrides without axes, as `preset=smoke`, `+ablation=consistency` or
            `train.steps=100`; none gives the baseline of `conf/config.yaml`.

    Raises:
        HydraException: An override is malformed, or there is no such key or file.
        OmegaConfBaseException: A value is missing or of another type; the message names its key.
        XrgsError: A value is out of its range; the message names its key.

    Example:
        >>> compose("preset=smoke", "train.steps=100").train.steps
        100
    """
    register()
    with hydra.initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        return to_conf(hydra.compose("config", list(overrides)))


def _as_object(cfg: DictConfig, name: str) -> Any:
    value = cfg[name]
    return OmegaConf.to_object(value) if OmegaConf.is_config(value) else value


def _check_known(value: Any, path: str) -> None:
    """Raise `XrgsError` where a `+` has added a key to the schema, which nothing would read."""
    for name, inner in vars(value).items():
        if name not in value.__dataclass_fields__:
            key = f"{path}{name}"
            raise XrgsError(f"{key}: there is no such key{did_you_mean(key, known_keys())}")
        if is_dataclass(inner):
            _check_known(inner, f"{path}{name}.")


def _check_plugins(components: ComponentsConf) -> None:
    """Check that every plugin's settings are a mapping; the plugin itself checks what is in it.

    Raises:
        XrgsError: One is something else; the message names its key.
    """
    for name, settings in components.plugins.items():
        if not isinstance(settings, dict):
            key = f"components.plugins.{name}"
            raise XrgsError(
                f"{key}={settings}: must be a mapping of settings, e.g. +{key}.weight=0.1"
            )


def from_dict(values: Any) -> Conf:
    """Convert what `dataclasses.asdict` made of a config back to the config.

    Texts are taken literally: a path may contain `${`, and a file of unknown origin must not read
    this process's environment.

    Args:
        values: Nested dicts of plain values.

    Returns:
        The config.

    Raises:
        OmegaConfBaseException: A key is unknown, or a value is missing or of another type.
        TypeError: `values` is no dict of a config.
    """
    escaped = escape_interpolations(values)
    conf = OmegaConf.to_object(OmegaConf.merge(_schema(), escaped))
    if not isinstance(conf, Conf):
        raise TypeError(f"expected a config of schema Conf, got {type(conf).__name__}")
    _check_plugins(conf.components)
    return conf


@cache
def _schema() -> DictConfig:
    """Return the schema of a config, which `OmegaConf.merge` copies."""
    schema: DictConfig = OmegaConf.structured(Conf)
    return schema


def escape_interpolations(value: Any) -> Any:
    r"""Escape `${` in texts, so that OmegaConf takes them literally.

    Args:
        value: A text, or any nesting of dicts and lists of values.

    Returns:
        The same with `\${` in place of `${`, and with twice the backslashes that come before it.
    """
    if isinstance(value, dict):
        return {name: escape_interpolations(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [escape_interpolations(inner) for inner in value]
    if not isinstance(value, str):
        return value
    return _INTERPOLATION.sub(lambda match: 2 * match[1] + r"\${", value)


def from_file(file: Path) -> tuple[Conf, dict[str, Any]]:
    """Read the config that a cell's folder holds as JSON.

    A file from before a key was added lacks it. The key's value in the baseline is taken, with
    which all that was added is off.

    Args:
        file: The JSON file.

    Returns:
        The config, and the keys that the file lacks with the values that were taken.

    Raises:
        XrgsError: The file can't be read, or has another schema; the message names the file and
            the key.
    """
    try:
        values = read_json(file)
        added = dict(_fill_in(values, _baseline(), ""))
        return from_dict(values), added
    except StoreError:
        raise
    except OmegaConfBaseException as error:
        raise XrgsError(
            f"{file}: {error_line(error)} (another version of xrgs may have written it)"
        ) from error
    except XrgsError as error:
        raise XrgsError(f"{file}: {error}") from error
    except (OverflowError, ValueError, TypeError) as error:
        raise XrgsError(f"{file}: it holds no config ({error})") from error


@cache
def _baseline() -> Mapping[str, Any]:
    """Return the values of `conf/config.yaml` itself; those that it leaves open are `???`."""
    conf = cast("DictConfig", OmegaConf.load(CONF_DIR / "config.yaml"))
    names = [*Conf.__dataclass_fields__]
    values = OmegaConf.to_container(OmegaConf.masked_copy(conf, names), resolve=True)
    return cast("Mapping[str, Any]", values)


def _fill_in(values: Any, baseline: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    """Add to a config what it lacks of the baseline; yield the keys that were added, with values.

    What is no mapping is left to the schema to refuse.
    """
    if not isinstance(values, dict):
        return
    for name, value in baseline.items():
        if isinstance(value, dict):
            yield from _fill_in(values.setdefault(name, {}), value, f"{path}{name}.")
        elif name not in values and value != MISSING:
            values[name] = value
            yield f"{path}{name}", value


def error_line(error: Exception) -> str:
    """Return the first line of an error's message, with the key that it is about.

    Args:
        error: Any exception. Those of OmegaConf know their key, and do not always print it.

    Returns:
        One line, that begins with the key where the message does not contain it.
    """
    line, key = str(error).splitlines()[0], getattr(error, "full_key", None)
    return line if not key or key in line else f"{key}: {line}"
