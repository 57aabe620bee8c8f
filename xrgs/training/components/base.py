"""The interface of a component: the hooks that training calls.

Before the first step training calls `densification_groups`, `before_training` and
`on_gaussians_changed`. Then every step calls these hooks of each component that is on, in this
order:

1. `allows_view`: whether the sampler may choose this view,
2. `training_views`: changes cameras and photographs for this step,
3. `render_camera`: changes the camera of the render,
4. `before_render`: changes the Gaussians for this render; then the render,
5. `to_photograph`: resizes the render to the photograph's size,
6. `match_colors`: changes the colours of the render,
7. `pixel_weights`: weights of the pixels in the photometric loss; then the loss,
8. `modify_loss`: adds terms to the loss or scales it,
9. `needs_backward`: whether to run the backward pass; then the backward pass,
10. `after_backward`: changes the gradients of the parameters; then the optimizer's step,
11. `densification_grad2d`: changes the image-plane gradient for densification,
12. `may_grow`: at a refinement, which Gaussians may grow,
13. `growth_scores`: at a refinement with a budget, which Gaussians grow first,
14. `opacity_attenuation`: at a reset of the opacities,
15. `on_gaussians_changed`: after a refinement or a reset with any change,
16. `to_prune`: further Gaussians to remove,
17. `on_gaussians_changed`: if any were removed,
18. `after_step`: changes the Gaussians at the end of the step.

A step without a backward pass skips 10 and 11. After the last step training calls `bake` and
`after_training`; `bake` also runs on a copy of the Gaussians at each evaluation during training.
Then the cell calls `findings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from xrgs.errors import XrgsError
from xrgs.splat.settings import NOMINAL_STEPS
from xrgs.training.dataset import LoadedView

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from xrgs.config import ComponentsConf, SplatConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
    from xrgs.splat.settings import DensifySettings
    from xrgs.splat.strategy.base import Groups
    from xrgs.training.dataset import Dataset

TrainingView = LoadedView
"""A training view as components see it."""


@dataclass(frozen=True)
class Step:
    """One step of training: its position in the run, and its view."""

    number: int
    """Number of the step, from 0."""
    total: int
    """Number of steps of the whole run."""
    view: TrainingView
    """The view that the step renders, from `training_views`."""
    log: dict[str, float] = field(default_factory=dict, compare=False)
    """`<component>.<quantity>` -> value of this step, a column of history.csv. A row there has the
    mean over the steps since the previous row in which a component recorded the quantity."""

    @property
    def nominal(self) -> float:
        """The step's position in a run of 30,000 steps, the unit of all schedules."""
        return self.number * NOMINAL_STEPS / self.total


class ViewRenderer(Protocol):
    """Renders training views for components (`xrgs.training.rendering.StepRenderer`).

    Its work and time are added to those of the run.
    """

    def photograph(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Render the step's view as for the loss: [H, W, 3], detached from autograd."""

    def attribute(self, pixels: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Sum a map [H, W] over the step's view, by the blending weights of each Gaussian: [N]."""


@dataclass(frozen=True)
class TrainingSetup:
    """The inputs for building a component."""

    components: ComponentsConf
    """Settings of all components, `components` of the config."""
    data: Dataset
    """The training views, the SfM points, the scene scale and the downsampling factor."""
    splat: SplatConf
    """Settings of the model, its optimizer and its densification, `splat` of the config."""
    backend: str
    """`torch` or `native`: the implementation of rendering and losses."""
    seed: int = 0
    """Seed of the run (`xrgs.training.seeding.seeded_generator`)."""


class Component:
    """One change to training. Every hook changes nothing unless a subclass overrides it.

    The hooks' `step` is the step with its view, `gaussians` are the N trained Gaussians, and images
    are [H, W, 3].

    Attributes:
        settings_type: For components of other packages: the dataclass of their settings. xrgs
            builds it from `components.plugins.<name>` of the config, and checks names and types.
    """

    settings_type: ClassVar[type[Any] | None] = None

    @classmethod
    def from_settings(cls, settings: Any, setup: TrainingSetup) -> Self | None:
        """Build the component from its settings.

        Args:
            settings: The component's settings: a dataclass of `xrgs.config`, or a `settings_type`
                for components of other packages.
            setup: The data, the model's settings and the other components' settings.

        Returns:
            The component, or None if the settings mean "off"; an "off" component must change
            nothing.

        Raises:
            XrgsError: A setting is out of range; the message names its key.
        """
        raise NotImplementedError(f"{cls.__name__} does not define from_settings")

    def before_training(self, renderer: ViewRenderer) -> None:
        """Get a renderer of any training view, with all components of the run.

        Training calls this once, before the first step or the first step after a checkpoint.
        """

    def allows_view(self, step: Step) -> bool:
        """Decide whether training may sample the step's view at that step.

        Returns:
            False if the view is excluded. The sampler skips it, and epochs that begin while it is
            excluded do not contain it.
        """
        return True

    def training_views(
        self, views: Mapping[str, TrainingView], step: Step
    ) -> Mapping[str, TrainingView]:
        """Choose the cameras and photographs for this step.

        Later hooks get the step's view from the result. The result must depend only on the number
        of the step, so that a continued run has the same views.

        Args:
            views: Name -> training view, of all views, as the previous components changed them.
            step: The step with the sampled view.

        Returns:
            Views of the same names and tags, each with a photograph of its camera's size. Return
            `views` itself for no change, and the same object as in the last step if nothing has
            changed since: for a new object, training prepares all photographs again.
        """
        return views

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Change the N Gaussians, scales in world units and opacities in 0..1, for this render.

        The result must be differentiable in `activated`.
        """
        return activated

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Choose the camera, of any size in px, for rendering the step's view.

        `camera` is that of the view, as the previous components changed it.
        """
        return camera

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Resize a render to the photograph's size, in the way the photograph was formed.

        A component that changes the size in `render_camera` restores it here. This hook runs in
        reverse order of the components.

        Args:
            image: The render [h, w, 3], as the components later in the order changed it.
            step: The step with its view.

        Returns:
            The image [H, W, 3] at the photograph's size, linear in `image`.
        """
        return image

    def match_colors(self, image: Tensor, step: Step) -> Tensor:
        """Map the colours of a render to those of its photograph, by exposure for example.

        Training calls this after `to_photograph`, with gradients enabled for the render of the
        step, and with gradients disabled for renders of other views that components ask for. Each
        pixel of the result must depend only on the same pixel of `image`.
        """
        return image

    def pixel_weights(self, step: Step) -> Tensor | None:
        """Return weights [H, W] of the pixels in the photometric loss; None if all are 1."""
        return None

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Change the loss before backward, by a further term or a factor.

        Args:
            loss: Scalar; the photometric loss, as the previous components changed it.
            image: [H, W, 3] render of the view after `match_colors`, not clamped to 0..1. Outside
                the view's mask it has the pixels of the photograph.
            gaussians: The N trained Gaussians; a term may depend on their parameters.
            step: The step with its view.

        Returns:
            The changed loss, a scalar.
        """
        return loss

    def needs_backward(self, loss: Tensor, step: Step) -> bool:
        """Decide whether the step runs a backward pass.

        Training calls this in every step, also if another component has returned False.

        Args:
            loss: Scalar; the loss of the step, with all terms and weights.
            step: The step with its view.

        Returns:
            False to skip the backward pass, the optimizer's step and the step's contribution to
            the densification statistics. Schedules, as the learning rate's, go on.
        """
        return True

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Change the gradients of the parameters in place, before the optimizer's step.

        A change of the gradient of `shN` has no effect: the optimizer computes it from the gradient
        of `sh0`.
        """

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Change the image-plane gradient [N, 2], per px, for the statistics of densification."""
        return grad2d

    def densification_groups(self, settings: DensifySettings) -> Groups | None:
        """Return thresholds of growth and pruning for each tag of views; None for common ones.

        Training calls this once, before the first step. Only one component may return groups.
        """
        return None

    def may_grow(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Choose which of the Gaussians above the growth threshold may grow.

        Training calls this at refinements, before any Gaussian grows.

        Returns:
            [N] bool, or None if all Gaussians may grow.
        """
        return None

    def growth_scores(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Rank the growing Gaussians if a budget has room for only some of them.

        Training calls this only at such refinements, before any Gaussian grows. The Gaussians with
        the highest scores grow.

        Returns:
            Scores [N], at least 0; None to rank by the mean image-plane gradient.
        """
        return None

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Choose further Gaussians to remove.

        Training calls this in every step, also after densification has stopped. If densification
        changed the Gaussians in this step, `on_gaussians_changed` was called before.

        Returns:
            [N] bool, True for a Gaussian to remove; None to keep all.
        """
        return None

    def after_step(self, gaussians: Gaussians, step: Step) -> None:
        """Change the values of the Gaussians in place, at the end of the step.

        The optimizer's moments stay as they are.
        """

    def opacity_attenuation(self, gaussians: Gaussians) -> Tensor | None:
        """Return the factors of the opacities in `before_render`, which are the same for all views.

        Training calls this at opacity resets. If the step was a refinement too,
        `on_gaussians_changed` has not been called for it yet.

        Returns:
            Factors [N] above 0 and at most 1; None if `before_render` does not change opacities.
        """
        return None

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Update state that depends on the number and order of the Gaussians.

        Training calls this before the first step, and whenever Gaussians were added, removed or
        reset.
        """

    def bake(self, gaussians: Gaussians) -> None:
        """Apply the change of `before_render` to the Gaussians themselves, in place.

        Only for changes that are the same in all views. Training calls this on the trained
        Gaussians before they are saved, and on a copy at each evaluation during training.
        """

    def after_training(self, gaussians: Gaussians) -> None:
        """Read the trained Gaussians before they are saved, for `findings` for example."""

    def findings(self) -> list[str]:
        """Return lines about the training or the photographs, for the cell's summary.

        Each line begins with the component's name, as in `floaters: ...`.
        """
        return []

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint: name -> tensor or JSON value; empty without any."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state of a component that was built from the same settings; never empty.

        Raises:
            KeyError: An entry is missing.
            ValueError: An entry does not fit.
        """


def check_not_negative(key: str, value: float) -> None:
    """Raise XrgsError, naming the config's key, unless the value is finite and at least 0."""
    if not (math.isfinite(value) and value >= 0):
        raise XrgsError(f"{key}={value}: must be a finite number, 0 or more")
