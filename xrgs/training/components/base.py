"""The interface of a component: the hooks that training calls, in the order of a step.

One step of training runs these hooks, each for every component that is on:

1. `allows_view` while the sampler chooses the step's view, then `training_views` on all views,
2. `before_render` on the activated Gaussians and `render_camera` on the view's camera, then the
   view is rendered, and `to_photograph` brings the render to the size of the photograph,
3. `pixel_weights` for the photometric loss, then `modify_loss` on that loss, then `needs_backward`,
4. backward, then `after_backward` on the gradients of the parameters, then the optimizer steps,
5. `densification_grad2d` on the image-plane gradient, then densification reads it; at its
   refinements `may_grow` and, where a budget leaves room for some Gaussians only, `growth_scores`,
6. `on_gaussians_changed` where densification has added, removed or reset Gaussians,
7. `to_prune`, and `on_gaussians_changed` where that has removed Gaussians.

A step that needs no backward pass leaves out 4 and `densification_grad2d`.

`densification_groups` and `before_training` are called once before the first step,
`opacity_attenuation` where densification resets opacities, `bake` wherever the Gaussians are
evaluated or saved, and `after_training` once after the last step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from xrgs.errors import XrgsError
from xrgs.splat.settings import NOMINAL_STEPS

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from collections.abc import Mapping

    from torch import Tensor

    from xrgs.capture.dataset import Dataset
    from xrgs.config import ComponentsConf, SplatConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
    from xrgs.splat.refinement import Groups
    from xrgs.splat.settings import DensifySettings


class TrainingView(Protocol):
    """A training view as components see it."""

    @property
    def name(self) -> str:
        """The name of the view's photograph, unique among the views."""

    @property
    def tag(self) -> str:
        """The resolution class of the view, `HR` or `LR`."""

    @property
    def rho(self) -> float:
        """The sampling rate of the view over the highest rate of all views, in (0, 1]."""

    @property
    def camera(self) -> Camera:
        """The camera in the normalised world."""

    @property
    def image(self) -> Tensor:
        """The photograph [H, W, 3] in 0..1, at the size at which the view is rendered."""


@dataclass(frozen=True)
class Step:
    """One step of training: its position in the run, and the view that it renders."""

    number: int
    """The number of the step, from 0."""
    total: int
    """The number of steps of the whole run."""
    view: TrainingView
    """The view that the step renders, as `training_views` has left it."""
    log: dict[str, float] = field(default_factory=dict, compare=False)
    """Values that components record of the step, by column names `<component>.<quantity>`. A row of
    history.csv has the mean of each over the steps since the row before that recorded it."""

    @property
    def nominal(self) -> float:
        """The position of the step in a run of 30,000 steps, in which schedules are written."""
        return self.number * NOMINAL_STEPS / self.total


class ViewRenderer(Protocol):
    """What renders training views, as components see it; `xrgs.training.rendering` has it.

    The work and the time that it takes are the run's.
    """

    def photograph(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Render the step's view as it is compared with its photograph: [H, W, 3], no graph."""

    def attribute(self, pixels: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Sum a map [H, W] of the view's photograph over what each Gaussian shows of it: [N]."""


@dataclass(frozen=True)
class TrainingSetup:
    """Everything that a component may read when it is built."""

    components: ComponentsConf
    """The settings of all components, `components` of the config."""
    data: Dataset
    """The training views, the SfM points, the scene scale and the downsampling factor."""
    splat: SplatConf
    """The settings of the model, its optimizer and its densification, `splat` of the config."""
    backend: str
    """`torch` or `native`: the implementation that renders and computes losses."""
    seed: int = 0
    """The seed of the run (`xrgs.training.seeding.seeded_generator`)."""


class Component:
    """One change to training. Every hook is the identity until a subclass overrides it.

    Attributes:
        settings_type: For components of other packages: the dataclass of their settings. xrgs
            builds it from `components.plugins.<name>` of the config, checking names and types.
    """

    settings_type: ClassVar[type[Any] | None] = None

    @classmethod
    def from_settings(cls, settings: Any, setup: TrainingSetup) -> Self | None:
        """Build the component that the settings describe.

        Args:
            settings: The component's own settings: a dataclass of `xrgs.config`, or a
                `settings_type` for components of other packages.
            setup: The data, the model's settings and the other components' settings.

        Returns:
            The component, or None where the settings leave it off, which must change nothing.

        Raises:
            XrgsError: A setting is out of its range; the message names its key.
        """
        raise NotImplementedError(f"{cls.__name__} does not define from_settings")

    def before_training(self, renderer: ViewRenderer) -> None:
        """Keep what renders training views, for a component that looks at more than the step's own.

        Training calls it once, before the first step, or before the first after a checkpoint.

        Args:
            renderer: Renders any training view with all components of the run.
        """

    def allows_view(self, step: Step) -> bool:
        """Decide whether training may sample the step's view at that step.

        Args:
            step: The step with the view in question.

        Returns:
            False excludes the view. The sampler skips it, and leaves it out of epochs that begin
            while it is excluded.
        """
        del step
        return True

    def training_views(
        self, views: Mapping[str, TrainingView], step: Step
    ) -> Mapping[str, TrainingView]:
        """Choose the cameras and the photographs that training uses at this step.

        All that comes after it sees a view of those that it returns as the step's view. They must
        be a function of the number of the step alone, so that a run that is continued has the same
        ones. What the loss prepares of a photograph is kept while the same tensor comes back.

        Args:
            views: All training views by name, or what the components before this one made of them.
            step: The step with its view as it was sampled.

        Returns:
            Views of the same names and tags, each with a photograph of its camera's size; `views`
            itself where nothing is changed, and the same object as at the step before where
            nothing has changed since.
        """
        del step
        return views

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Change the Gaussians for this step's render alone.

        Args:
            activated: N Gaussians with their scales in world units and their opacities in 0..1.
            step: The step with its view.

        Returns:
            The N Gaussians to render, differentiable in those given.
        """
        del step
        return activated

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Choose the camera that the step's view is rendered with.

        Args:
            camera: The camera of the view, or what the components before this one made of it.
            step: The step with its view.

        Returns:
            A camera that shows the same at any size in px.
        """
        del step
        return camera

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Bring a render to the size of the photograph, as the photograph was formed.

        A component that changes the size in `render_camera` brings it back here.

        Args:
            image: The render [h, w, 3] of the step's view, or what the components behind this one
                made of it: they are called in reverse order.
            step: The step with its view.

        Returns:
            The image [H, W, 3] that is compared with the photograph, differentiable in `image`.
        """
        del step
        return image

    def pixel_weights(self, step: Step) -> Tensor | None:
        """Weight the pixels of the view in the photometric loss.

        Args:
            step: The step with its view.

        Returns:
            Weights [H, W] of the view's pixels, or None where every pixel has weight 1.
        """
        del step
        return None

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Change the loss before backward, by a further term or a factor.

        Args:
            loss: Scalar; the photometric loss as the components before this one have changed it.
            image: [H, W, 3] render of the view at the photograph's size, not clamped to 0..1.
            gaussians: The N Gaussians that are trained; a term may depend on their parameters.
            step: The step with its view.

        Returns:
            The scalar to call backward on.
        """
        del image, gaussians, step
        return loss

    def needs_backward(self, loss: Tensor, step: Step) -> bool:
        """Decide whether the step's loss is worth a backward pass.

        Training calls it once in every step, whatever the other components answer.

        Args:
            loss: Scalar; the loss of the step, with all terms and weights.
            step: The step with its view.

        Returns:
            False leaves out the backward pass, the optimizer's step and the step's part in the
            statistics of densification. Schedules go on, that of the rate of the means too.
        """
        del loss, step
        return True

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Change the gradients of the parameters in place, before the optimizer reads them.

        Args:
            gaussians: The N Gaussians with their gradients. A change of the gradient of `shN` has
                no effect: the optimizer computes it from the gradient of `sh0`.
            step: The step with its view.
        """

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Change the image-plane gradient that densification averages, and nothing else.

        Args:
            grad2d: [N, 2] gradient of the loss with respect to the projected means, per pixel.
            step: The step with its view.

        Returns:
            The gradient [N, 2] that densification reads in its place.
        """
        del step
        return grad2d

    def densification_groups(self, settings: DensifySettings) -> Groups | None:
        """Give groups of views their own thresholds of densification and pruning.

        Training calls it once, before the first step. At most one component may return groups.

        Args:
            settings: The settings of densification.

        Returns:
            The thresholds by the views' tags, or None to leave densification as it is.
        """
        del settings
        return None

    def may_grow(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Choose which Gaussians densification may grow, of those above its growth threshold.

        Training asks at a refinement alone, before anything is grown or removed.

        Args:
            gaussians: The N Gaussians.
            step: The step with its view.

        Returns:
            [N] bool, or None where all of them may.
        """
        del gaussians, step
        return None

    def growth_scores(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Rank Gaussians where a budget leaves room for some of those that would grow.

        Training asks at such a refinement alone, before anything is grown or removed. Those of the
        highest score grow.

        Args:
            gaussians: The N Gaussians.
            step: The step with its view.

        Returns:
            Scores [N] of at least 0; None ranks by the mean image-plane gradient.
        """
        del gaussians, step
        return None

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Choose Gaussians to remove, whatever densification does with the others.

        Training asks after every step, also when densification has stopped already. The components
        have been told of what densification changed in this step.

        Args:
            gaussians: The N Gaussians.
            step: The step with its view.

        Returns:
            [N] bool, or None where all of them stay.
        """
        del gaussians, step
        return None

    def opacity_attenuation(self, gaussians: Gaussians) -> Tensor | None:
        """Tell by how much `before_render` lowers opacities in every view.

        Training asks when it resets the opacities, with Gaussians that `on_gaussians_changed` has
        not been told of yet.

        Args:
            gaussians: The N Gaussians.

        Returns:
            Factors [N] above 0 and at most 1, or None where opacities stay as they are.
        """
        del gaussians
        return None

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Update what depends on the number and the order of the Gaussians.

        Training calls it before the first step, and whenever densification or `to_prune` has
        added, removed or reset Gaussians.

        Args:
            gaussians: The N Gaussians as they are now.
        """

    def bake(self, gaussians: Gaussians) -> None:
        """Make what `before_render` does in every view part of the Gaussians, in place.

        It is called on the trained Gaussians before they are saved, and on a copy of them whenever
        they are evaluated during training.

        Args:
            gaussians: The N Gaussians.
        """

    def after_training(self, gaussians: Gaussians) -> None:
        """Look at the trained Gaussians, before they are saved.

        Args:
            gaussians: The N trained Gaussians.
        """

    def state_dict(self) -> dict[str, Any]:
        """Return what the steps so far have changed in the component, for a checkpoint.

        Returns:
            Tensors and JSON values by name; empty for a component without state.
        """
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Args:
            state: The state of a component that was built from the same settings; never empty.

        Raises:
            KeyError: An entry is missing.
            ValueError: An entry does not fit.
        """


def check_not_negative(key: str, value: float) -> None:
    """Check that a setting is a finite number of at least 0.

    Args:
        key: The key of the setting in the config, for the message.
        value: The value of the setting.

    Raises:
        XrgsError: It is not; the message names the key.
    """
    if not (math.isfinite(value) and value >= 0):
        raise XrgsError(f"{key}={value}: must be a finite number, 0 or more")
