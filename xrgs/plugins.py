"""Components of other installed packages, found by their entry points.

A package provides a component by an entry point in the group `xrgs.components`; the name of the
entry point is the key under `components.plugins` of the config. Finding a plugin and hashing its
source for identities executes none of its code. Only `load` imports it, and trainings and dry runs
call `load` only for the plugins in a cell's config. That config comes from the user's command line
and files; a config from a store is trained again only if the user names its plugins
(`xrgs.sweep.rerun`). So a store from another person never makes xrgs import a package.

This module does not import torch, so that planning and reporting stay quick.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from xrgs.errors import XrgsError
from xrgs.safeio.code import CodeFolders, digest_files
from xrgs.safeio.hashing import digest

GROUP = "xrgs.components"
"""The entry point group of components."""

_BYTECODE = frozenset({".pyc", ".pyo"})
_Settings = TypeVar("_Settings")


def installed() -> list[str]:
    """Return the sorted names of the plugins in all installed packages."""
    return sorted({point.name for point in entry_points(group=GROUP)})


def find(name: str) -> EntryPoint:
    """Find the entry point of a plugin, without importing its package.

    Returns:
        The entry point; its value is `package.module:Class`.

    Raises:
        XrgsError: No installed package has the plugin, or several have it.
    """
    points = list(entry_points(group=GROUP, name=name))
    if not points:
        names = ", ".join(installed()) or "none"
        raise XrgsError(
            f"components.plugins.{name}: no installed package offers a component of this name in"
            f" the entry point group {GROUP}; installed are: {names}"
        )
    if len({point.value for point in points}) > 1:
        packages = " and ".join(sorted(point.dist.name for point in points if point.dist))
        raise XrgsError(
            f"components.plugins.{name}: {packages} offer a component of this name; uninstall one"
        )
    return points[0]


def code_digest(name: str, folders: CodeFolders) -> str:
    """Return a digest of a plugin's source, without importing its package.

    It covers the value of the entry point, all files of its package except bytecode and hidden
    files (or the file of a single module), and the modules of built-in components that these files
    import, to extend them for example. It does not cover imports from other packages.

    Args:
        name: The name of the plugin.
        folders: The code of xrgs that trains, with the built-in components.

    Raises:
        XrgsError: The plugin is not installed, or has no source file.
    """
    point = find(name)
    origin = _origin(point.module)
    if origin is None or not origin.is_file():
        raise XrgsError(
            f"components.plugins.{name}: the entry point {point.value} names no module whose files"
            " can be hashed for the identity of cells; install the package again"
        )
    is_package = origin.stem == "__init__"
    base = origin.parent.parent if is_package else origin.parent
    files = _package_files(origin.parent) if is_package else [origin]
    source_files = {file.relative_to(base).as_posix(): file for file in files}
    source_files |= folders.needed_by(source_files.values())
    return digest([point.value, digest_files(source_files)])


def load(name: str) -> object:
    """Import a plugin's package and return the object of its entry point.

    Returns:
        The object; the caller checks its type.

    Raises:
        XrgsError: The plugin is not installed, or cannot be imported.
    """
    point = find(name)
    try:
        return point.load()
    except Exception as error:  # importing may raise any error
        raise XrgsError(
            f"components.plugins.{name}: importing {point.value} failed:"
            f" {type(error).__name__}: {error}"
        ) from error


def check(name: str, values: Mapping[str, Any]) -> None:
    """Import a plugin and check its settings, before a training does.

    Raises:
        XrgsError: As `load` and `parse_settings`, or the plugin has no settings.
    """
    key = f"components.plugins.{name}"
    kind = getattr(load(name), "settings_type", None)
    if kind is None:
        raise XrgsError(
            f"{key}: its entry point {find(name).value} must name a subclass of"
            " xrgs.training.components.Component that defines settings_type"
        )
    parse_settings(kind, values, key)


def parse_settings(kind: type[_Settings], values: Mapping[str, Any], key: str) -> _Settings:
    """Build the settings of a plugin from its values in the config.

    Args:
        kind: The dataclass of the settings. Fields of type bool, int, float or str are checked; a
            float accepts whole numbers. Fields of other types are passed unchecked.
        values: Name -> value.
        key: The key of the plugin in the config, for messages.

    Returns:
        The settings, with defaults for missing values.

    Raises:
        XrgsError: A name is unknown, or a value is missing or of the wrong type; the message names
            the key.
    """
    hints = get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for name in values:
        if name not in fields:
            raise XrgsError(
                f"{key}.{name}: there is no such setting; there are: {', '.join(fields) or 'none'}"
            )
    for name, field in fields.items():
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and name not in values:
            raise XrgsError(f"{key}.{name}: is missing; set it, e.g. +{key}.{name}=...")
    return kind(**{name: _typed(f"{key}.{name}", v, hints[name]) for name, v in values.items()})


def _typed(key: str, value: Any, kind: Any) -> Any:
    """Convert a value to bool, int, float or str; return it unchecked for any other type."""
    if kind not in {bool, int, float, str}:
        return value
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise XrgsError(f"{key}={value}: must be of type {kind.__name__}")
    return value


def _origin(module: str) -> Path | None:
    """Return the file of the first part of a dotted name that is not a namespace package.

    `importlib.util.find_spec` imports the parents of a dotted name, but namespace packages have no
    code. So the first part with code is found without importing code.
    """
    first, *rest = module.split(".")
    spec: ModuleSpec | None
    try:
        spec = find_spec(first)
    except (ImportError, ValueError):
        return None
    name = first
    for part in rest:
        if spec is None or spec.origin is not None or spec.submodule_search_locations is None:
            break
        name = f"{name}.{part}"
        spec = PathFinder.find_spec(name, list(spec.submodule_search_locations))
    return Path(spec.origin) if spec is not None and spec.origin is not None else None


def _package_files(folder: Path) -> Iterator[Path]:
    """Yield the files of a package in a fixed order, except bytecode and hidden files."""
    for file in sorted(folder.rglob("*")):
        parts = file.relative_to(folder).parts
        hidden = any(part.startswith(".") for part in parts)
        if file.is_file() and not hidden and file.suffix not in _BYTECODE:
            yield file
