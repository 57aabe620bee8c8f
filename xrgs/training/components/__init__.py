"""The components of XR-GS [xrgs], and the hooks by which training calls them.

A component that is off is not imported, so the baseline executes none of its code. The docstrings
of the components list what the paper leaves open, under "our choice where the paper is silent".

`xrgs.registry` lists the components. A component of another package is not in it:
`xrgs.plugins` finds it by its entry point. docs/extend.md says how to write either kind.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from xrgs import plugins
from xrgs.config import is_on
from xrgs.errors import XrgsError
from xrgs.registry import BUILT_IN
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    ViewRenderer,
    check_not_negative,
)
from xrgs.training.components.combined import Components

if TYPE_CHECKING:
    from collections.abc import Mapping

    from xrgs.config import ComponentsConf, SplatConf
    from xrgs.training.dataset import Dataset

__all__ = [
    "Component",
    "Components",
    "Step",
    "TrainingSetup",
    "TrainingView",
    "ViewRenderer",
    "build",
    "check_not_negative",
]


def build(
    conf: ComponentsConf, data: Dataset, splat: SplatConf, backend: str = "torch", seed: int = 0
) -> Components:
    """Build the components that are on; the arguments are those of `TrainingSetup`.

    Returns:
        The built-in components that are on, then those of other packages in order of their names.

    Raises:
        XrgsError: A value is out of range, a view is too small for its paired image, a component
            has no view or weight to act on, or a plugin cannot be used.
    """
    setup = TrainingSetup(conf, data, splat, backend, seed)
    built: list[Component | None] = []
    for key, entry in BUILT_IN.items():
        if any(is_on(getattr(conf, name)) for name in (key, *entry.reads)):
            kind = getattr(import_module(f"{__name__}.{entry.module}"), entry.name)
            built.append(kind.from_settings(getattr(conf, key), setup))
    built += [_build_plugin(name, values, setup) for name, values in sorted(conf.plugins.items())]
    return Components(component for component in built if component is not None)


def _build_plugin(name: str, values: Mapping[str, Any], setup: TrainingSetup) -> Component | None:
    key = f"components.plugins.{name}"
    kind = plugins.load(name)
    if not (isinstance(kind, type) and issubclass(kind, Component)):
        raise XrgsError(
            f"{key}: its entry point {plugins.find(name).value} must name a subclass of"
            " xrgs.training.components.Component"
        )
    if kind.settings_type is None:
        raise XrgsError(
            f"{key}: {kind.__name__} must define settings_type, the dataclass of its settings"
        )
    settings = plugins.parse_settings(kind.settings_type, values, key)
    try:
        return kind.from_settings(settings, setup)
    except XrgsError:
        raise
    except Exception as error:  # another package may raise any error; the message names its key
        raise XrgsError(f"{key}: {type(error).__name__}: {error}") from error
