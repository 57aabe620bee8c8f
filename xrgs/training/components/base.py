"""What a component of XR-GS is: the hooks by which training calls it, in the order of a step."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import torch

from xrgs.errors import XrgsError
from xrgs.splat.settings import NOMINAL_STEPS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from xrgs.splat.cameras import Camera
    from xrgs.splat.densify import Groups
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
    from xrgs.splat.settings import DensifySettings


class TrainingView(Protocol):
    """What a component may know of a view."""

    @property
    def name(self) -> str:
        """Its photograph's, unique among the views."""

    @property
    def tag(self) -> str:
        """`HR` or `LR`."""

    @property
    def rho(self) -> float:
        """Its sampling rate over the finest of all views', in (0, 1]."""

    @property
    def camera(self) -> Camera:
        """In the normalised world."""

    @property
    def image(self) -> Tensor:
        """The photograph [H, W, 3] at the size it is rendered at."""


@dataclass(frozen=True)
class Step:
    """One step of training: where it is in the run, and the view it is of."""

    number: int
    """From 0."""
    of: int
    """Steps of the whole run."""
    view: TrainingView
    log: dict[str, float] = field(default_factory=dict, compare=False)
    """What components note of the step, by a column of the history, `<component>.<what>`. A row of
    the history has the mean over the steps, since the row before, that noted it."""

    @property
    def nominal(self) -> float:
        """Where it would be in a run of 30,000 steps, for which schedules are written."""
        return self.number * NOMINAL_STEPS / self.of


class Component:
    """One change to training. Each hook is the identity until a component overrides it."""

    def trains_on(self, step: Step) -> bool:
        """Whether the view may be drawn at that step."""
        del step
        return True

    def activated(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """The Gaussians to render in place of those given, differentiable in them."""
        del step
        return activated

    def pixel_weight(self, step: Step) -> Tensor | None:
        """What each pixel [H, W] weighs in the photometric loss; None where all weigh 1."""
        del step
        return None

    def loss(self, loss: Tensor, image: Tensor, step: Step) -> Tensor:
        """The loss to go on with, before backward.

        Args:
            loss: Scalar, what the components before this one made of the photometric loss.
            image: [H, W, 3] render of the view, unclamped.
            step: With its view.
        """
        del image, step
        return loss

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Change the parameters' gradients in place, before the optimizer reads them."""

    def densification_grad2d(self, gradient: Tensor, step: Step) -> Tensor:
        """The image-plane gradient [N, 2] that densification is to read, in place of that given."""
        del step
        return gradient

    def groups(self, settings: DensifySettings) -> Groups | None:
        """The views that densification tells apart, by their tags; None where it is to tell none.

        Asked once, before training; at most one of the components may have an answer.
        """
        del settings
        return None

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Gaussians came or went, or training begins."""

    def finish(self, gaussians: Gaussians) -> None:
        """Training is over: make the Gaussians, in place, those that are to be shown and kept."""

    def state_dict(self) -> dict[str, Any]:
        """What the steps so far have made of it, for a checkpoint; nothing where none did."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Become what `state_dict` told of; not called where that was nothing.

        Raises:
            KeyError: Something is missing.
            ValueError: Something does not fit.
        """


class Components(tuple[Component, ...]):
    """The components that are on, in the order that their hooks run; none is the baseline."""

    __slots__ = ()

    def trains_on(self, step: Step) -> bool:
        """Whether all of them allow the step's view."""
        return all(component.trains_on(step) for component in self)

    def activated(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """`Component.activated` of each in turn."""
        for component in self:
            activated = component.activated(activated, step)
        return activated

    def pixel_weight(self, step: Step) -> Tensor | None:
        """The product of `Component.pixel_weight` of each that has one; None where none has."""
        weights = [weight for c in self if (weight := c.pixel_weight(step)) is not None]
        return functools.reduce(torch.mul, weights) if weights else None

    def loss(self, loss: Tensor, image: Tensor, step: Step) -> Tensor:
        """`Component.loss` of each in turn; the very `loss` given where none is on."""
        for component in self:
            loss = component.loss(loss, image, step)
        return loss

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """`Component.after_backward` of each in turn."""
        for component in self:
            component.after_backward(gaussians, step)

    def densification_grad2d(self, gradient: Tensor, step: Step) -> Tensor:
        """`Component.densification_grad2d` of each in turn."""
        for component in self:
            gradient = component.densification_grad2d(gradient, step)
        return gradient

    def groups(self, settings: DensifySettings) -> Groups | None:
        """`Component.groups` of the one that has an answer."""
        answers = (component.groups(settings) for component in self)
        return next((answer for answer in answers if answer is not None), None)

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """`Component.on_gaussians_changed` of each in turn."""
        for component in self:
            component.on_gaussians_changed(gaussians)

    def finish(self, gaussians: Gaussians) -> None:
        """`Component.finish` of each in turn."""
        for component in self:
            component.finish(gaussians)

    def state_dict(self) -> dict[str, Any]:
        """`Component.state_dict` of those that have one, by their classes' names."""
        states = {type(component).__name__: component.state_dict() for component in self}
        return {name: state for name, state in states.items() if state}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """`Component.load_state_dict` of those that are in `state`."""
        for component in self:
            name = type(component).__name__
            if name in state:
                component.load_state_dict(state[name])


def not_negative(key: str, value: float) -> None:
    """Raise `XrgsError`, naming the key, unless its value is finite and 0 or more."""
    if not (math.isfinite(value) and value >= 0):
        raise XrgsError(f"{key}={value}: must be a finite number, 0 or more")
