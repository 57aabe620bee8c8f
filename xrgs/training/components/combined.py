"""All components of a run as one: each hook combines the answers of the components."""

from __future__ import annotations

import functools
import operator
from typing import TYPE_CHECKING, Any

from xrgs.errors import XrgsError
from xrgs.splat.strategy.refinement import StrategyHooks
from xrgs.training.components.base import Component

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from torch import Tensor

    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
    from xrgs.splat.settings import DensifySettings
    from xrgs.splat.strategy.base import Strategy
    from xrgs.splat.strategy.refinement import Groups
    from xrgs.training.components.base import Step, TrainingView, ViewRenderer


#: The hooks by which components decide what densification grows.
_GROWTH = ("densification_groups", "may_grow", "growth_scores")


class Components(tuple[Component, ...]):
    """The components that are on, in the order in which their hooks run; empty is the baseline."""

    __slots__ = ()

    def override(self, hook: str) -> bool:
        """Whether any component has a hook of its own; without one, the hook is the identity."""
        return any(_overrides(type(component), hook) for component in self)

    def before_training(self, renderer: ViewRenderer) -> None:
        """Call `Component.before_training` of each component in turn."""
        for component in self:
            component.before_training(renderer)

    def allows_view(self, step: Step) -> bool:
        """Whether every component allows the step's view."""
        return all(component.allows_view(step) for component in self)

    def training_views(
        self, views: Mapping[str, TrainingView], step: Step
    ) -> Mapping[str, TrainingView]:
        """Apply `Component.training_views` of each component in turn."""
        for component in self:
            views = component.training_views(views, step)
        return views

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Apply `Component.before_render` of each component in turn."""
        for component in self:
            activated = component.before_render(activated, step)
        return activated

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Apply `Component.render_camera` of each component in turn."""
        for component in self:
            camera = component.render_camera(camera, step)
        return camera

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Apply `Component.to_photograph` of each component, the last one first."""
        for component in reversed(self):
            image = component.to_photograph(image, step)
        return image

    def match_colors(self, image: Tensor, step: Step) -> Tensor:
        """Apply `Component.match_colors` of each component in turn."""
        for component in self:
            image = component.match_colors(image, step)
        return image

    def pixel_weights(self, step: Step) -> Tensor | None:
        """The product [H, W] of the components' pixel weights; None where none has any."""
        return _combined(operator.mul, (c.pixel_weights(step) for c in self))

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Apply `Component.modify_loss` of each component in turn."""
        for component in self:
            loss = component.modify_loss(loss, image, gaussians, step)
        return loss

    def needs_backward(self, loss: Tensor, step: Step) -> bool:
        """Whether every component needs the backward pass."""
        # A list, so that every component is asked: some count their calls.
        answers = [component.needs_backward(loss, step) for component in self]
        return all(answers)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Call `Component.after_backward` of each component in turn."""
        for component in self:
            component.after_backward(gaussians, step)

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Apply `Component.densification_grad2d` of each component in turn."""
        for component in self:
            grad2d = component.densification_grad2d(grad2d, step)
        return grad2d

    def densification_groups(self, settings: DensifySettings) -> Groups | None:
        """The groups of the one component that has any.

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
        """Refuse components that decide what grows, for a strategy that does not ask them.

        Args:
            name: The strategy's name, `splat.strategy` of the config.
            strategy: Its class.

        Raises:
            XrgsError: The message names the components.
        """
        kinds = [type(component) for component in self]
        deciding = [
            kind.__name__ for kind in kinds if any(_overrides(kind, hook) for hook in _GROWTH)
        ]
        if deciding and not strategy.asks_components:
            raise XrgsError(
                f"splat.strategy={name}: it draws the Gaussians that grow, which"
                f" {' and '.join(deciding)} would decide; switch that off, or use"
                " splat.strategy=default"
            )

    def may_grow(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Which Gaussians [N] every component lets grow; None where all of them may."""
        return _combined(operator.and_, (c.may_grow(gaussians, step) for c in self))

    def growth_scores(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """The product [N] of the components' scores; None where none has any."""
        return _combined(operator.mul, (c.growth_scores(gaussians, step) for c in self))

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Which Gaussians [N] any component removes; None where all of them stay."""
        return _combined(operator.or_, (c.to_prune(gaussians, step) for c in self))

    def after_step(self, gaussians: Gaussians, step: Step) -> None:
        """Call `Component.after_step` of each component in turn."""
        for component in self:
            component.after_step(gaussians, step)

    def opacity_attenuation(self, gaussians: Gaussians) -> Tensor | None:
        """The product [N] of the components' attenuations; None where none has any."""
        return _combined(operator.mul, (c.opacity_attenuation(gaussians) for c in self))

    def strategy_hooks(self, step: Step) -> StrategyHooks:
        """What the components decide about densification at a step."""
        return StrategyHooks(
            may_grow=lambda gaussians: self.may_grow(gaussians, step),
            growth_scores=lambda gaussians: self.growth_scores(gaussians, step),
            opacity_attenuation=self.opacity_attenuation,
        )

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Call `Component.on_gaussians_changed` of each component in turn."""
        for component in self:
            component.on_gaussians_changed(gaussians)

    def bake(self, gaussians: Gaussians) -> None:
        """Call `Component.bake` of each component in turn."""
        for component in self:
            component.bake(gaussians)

    def after_training(self, gaussians: Gaussians) -> None:
        """Call `Component.after_training` of each component in turn."""
        for component in self:
            component.after_training(gaussians)

    def state_dict(self) -> dict[str, Any]:
        """The states of the components that have one, by position and class name."""
        states = {name: component.state_dict() for name, component in self._named()}
        return {name: state for name, state in states.items() if state}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the components that have an entry in `state`."""
        for name, component in self._named():
            if name in state:
                component.load_state_dict(state[name])

    def _named(self) -> list[tuple[str, Component]]:
        """Each component with a name that is unique even where class names are not."""
        return [(f"{i}.{type(component).__name__}", component) for i, component in enumerate(self)]


def _overrides(kind: type[Component], hook: str) -> bool:
    return getattr(kind, hook) is not getattr(Component, hook)


def _combined(
    combine: Callable[[Tensor, Tensor], Tensor], answers: Iterable[Tensor | None]
) -> Tensor | None:
    """Reduce the answers that are not None; None where there is none."""
    given = [answer for answer in answers if answer is not None]
    return functools.reduce(combine, given) if given else None
