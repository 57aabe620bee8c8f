"""The components of XR-GS [xrgs], and the hooks by which training calls them.

A component that is off is not imported, so the baseline executes none of its code. The docstrings
of the components list what the paper leaves open, under "our choice where the paper is silent".

`xrgs.registry` lists the components. A component of another package is not in it:
`xrgs.plugins` finds it by its entry point. docs/extend.md says how to write either kind.
"""

from __future__ import annotations

import functools
import operator
from importlib import import_module
from typing import TYPE_CHECKING, Any

from xrgs import plugins
from xrgs.config import is_on
from xrgs.errors import XrgsError
from xrgs.registry import BUILT_IN
from xrgs.splat.settings import outside_limits
from xrgs.splat.strategy.base import StrategyHooks
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    ViewRenderer,
    check_not_negative,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from torch import Tensor

    from xrgs.config import ComponentsConf, SplatConf
    from xrgs.splat.settings import DensifySettings
    from xrgs.splat.strategy.base import Groups, Strategy
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
            for name in (key, *entry.reads):
                for message in outside_limits(getattr(conf, name), f"components.{name}."):
                    raise XrgsError(message)
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


#: The hooks that influence which Gaussians grow.
_GROWTH = ("densification_groups", "may_grow", "growth_scores")


class Components(tuple[Component, ...], Component):
    """The components that are on, in the order of their hooks; empty is the baseline.

    The tuple is a component itself: `_FOLDS` has the function that combines each hook's results.
    """

    __slots__ = ()

    def override(self, hook: str) -> bool:
        """Whether any component overrides a hook; otherwise the hook changes nothing."""
        return any(_overrides(type(component), hook) for component in self)

    def densification_groups(self, settings: DensifySettings) -> Groups | None:
        """Return the groups of the one component that has any.

        Raises:
            XrgsError: Two components have groups.
        """
        groups = {
            type(component).__name__: answer
            for component in self
            if (answer := component.densification_groups(settings)) is not None
        }
        if len(groups) > 1:
            raise XrgsError(
                f"components: {' and '.join(groups)} both set thresholds of densification; switch"
                " one of them off"
            )
        return next(iter(groups.values()), None)

    def check_strategy(self, name: str, strategy: type[Strategy]) -> None:
        """Refuse components with growth hooks for a strategy that does not call these hooks.

        Raises:
            XrgsError: The message names the components, and the strategy's name.
        """
        deciding = [
            type(component).__name__
            for component in self
            if any(_overrides(type(component), hook) for hook in _GROWTH)
        ]
        if deciding and not strategy.asks_components:
            raise XrgsError(
                f"splat.strategy={name}: it draws the Gaussians that grow, which"
                f" {' and '.join(deciding)} would decide; switch that off, or use"
                " splat.strategy=default"
            )

    def strategy_hooks(self, step: Step) -> StrategyHooks:
        """Return the components' hooks for the strategy at a step."""
        return StrategyHooks(
            may_grow=lambda gaussians: self.may_grow(gaussians, step),
            growth_scores=lambda gaussians: self.growth_scores(gaussians, step),
            opacity_attenuation=self.opacity_attenuation,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return `<position>.<class name>` -> state, of the components that have a state."""
        states = {name: component.state_dict() for name, component in self._named()}
        return {name: state for name, state in states.items() if state}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the components that have an entry in `state`."""
        for name, component in self._named():
            if name in state:
                component.load_state_dict(state[name])

    def _named(self) -> list[tuple[str, Component]]:
        """Return each component with a unique name, even if class names repeat."""
        return [(f"{i}.{type(component).__name__}", component) for i, component in enumerate(self)]


def _overrides(kind: type[Component], hook: str) -> bool:
    return getattr(kind, hook) is not getattr(Component, hook)


def _call(hooks: list[Callable[..., None]], *arguments: Any) -> None:
    """Call each hook in turn."""
    for hook in hooks:
        hook(*arguments)


def _apply(hooks: list[Callable[..., Any]], value: Any, *arguments: Any) -> Any:
    """Pass a value through each hook in turn."""
    for hook in hooks:
        value = hook(value, *arguments)
    return value


def _all(hooks: list[Callable[..., bool]], *arguments: Any) -> bool:
    """Return whether all hooks return True. Every hook is called, since some count their calls."""
    answers = [hook(*arguments) for hook in hooks]
    return all(answers)


def _reduce(
    combine: Callable[[Tensor, Tensor], Tensor],
    hooks: list[Callable[..., Tensor | None]],
    *arguments: Any,
) -> Tensor | None:
    """Combine the results that are not None; return None if there are none."""
    answers = [answer for hook in hooks if (answer := hook(*arguments)) is not None]
    return functools.reduce(combine, answers) if answers else None


#: Hook -> function that combines the components' results.
_FOLDS: dict[str, Callable[..., Any]] = {
    "before_training": _call,
    "allows_view": _all,
    "training_views": _apply,
    "before_render": _apply,
    "render_camera": _apply,
    "to_photograph": lambda hooks, *arguments: _apply(hooks[::-1], *arguments),
    "match_colors": _apply,
    "pixel_weights": functools.partial(_reduce, operator.mul),
    "modify_loss": _apply,
    "needs_backward": _all,
    "after_backward": _call,
    "densification_grad2d": _apply,
    "may_grow": functools.partial(_reduce, operator.and_),
    "growth_scores": functools.partial(_reduce, operator.mul),
    "to_prune": functools.partial(_reduce, operator.or_),
    "after_step": _call,
    "opacity_attenuation": functools.partial(_reduce, operator.mul),
    "on_gaussians_changed": _call,
    "bake": _call,
    "after_training": _call,
    "findings": lambda hooks: [line for hook in hooks for line in hook()],
}


def _combined(name: str, fold: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(getattr(Component, name))
    def combined(self: Components, *arguments: Any) -> Any:
        return fold([getattr(component, name) for component in self], *arguments)

    return combined


for _name, _fold in _FOLDS.items():
    setattr(Components, _name, _combined(_name, _fold))
