"""The interface of a component: the hooks that training calls.

Before the first step training calls `densification_groups`, `before_training` and
`on_gaussians_changed`. Then every step calls these hooks of each component that is on, in this
order:

1. `allows_view`: may the sampler choose this view?
2. `training_views`: the cameras and photographs of this step,
3. `render_camera`: the camera of the render,
4. `before_render`: the Gaussians of the render, which follows,
5. `to_photograph`: the render at the size of the photograph,
6. `match_colors`: its colours,
7. `pixel_weights`: the weights of the pixels in the photometric loss, which follows,
8. `modify_loss`: further terms and factors of the loss,
9. `needs_backward`: is the loss worth a backward pass? It follows.
10. `after_backward`: the gradients of the parameters, before the optimizer's step, which follows,
11. `densification_grad2d`: the image-plane gradient that densification reads,
12. `may_grow`: at a refinement, which Gaussians may grow,
13. `growth_scores`: at a refinement with a budget, which Gaussians grow first,
14. `opacity_attenuation`: at a reset of the opacities,
15. `on_gaussians_changed`: after a refinement or a reset that changed anything,
16. `to_prune`: further Gaussians to remove,
17. `on_gaussians_changed`: after that has removed any,
18. `after_step`: the Gaussians as the next step gets them.

A step without a backward pass leaves out 10 and 11. After the last step training calls `bake` and
`after_training`; `bake` also runs on a copy of the Gaussians wherever they are evaluated. Then the
cell asks for `findings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from xrgs.errors import XrgsError
from xrgs.splat.settings import NOMINAL_STEPS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from xrgs.config import ComponentsConf, SplatConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
    from xrgs.splat.settings import DensifySettings
    from xrgs.splat.strategy.refinement import Groups
    from xrgs.training.dataset import Dataset


class TrainingView(Protocol):
    """A training view as components see it."""

    @property
    def name(self) -> str:
        """The name of the view's photograph, unique among the views."""

    @property
    def tag(self) -> str:
        """The resolution class of the view, `HR` or `LR`."""

    @property
    def sampling_rate(self) -> float:
        """The sampling rate of the view over the highest rate of all views, in (0, 1]."""

    @property
    def supersampling(self) -> float:
        """How many times as many px a side the view needs to be as fine as the finest views."""

    @property
    def camera(self) -> Camera:
        """The camera in the normalised world."""

    @property
    def image(self) -> Tensor:
        """The photograph [H, W, 3] in 0..1. It may be a new tensor at each access.

        Outside the mask it has colours of the inside, never what the mask hides.
        """

    @property
    def mask(self) -> Tensor | None:
        """The pixels that are used [H, W] bool, at least one; None where all are."""


@dataclass(frozen=True)
class Step:
    """One step of training: its position in the run, and the view that it renders."""

    number: int
    """The number of the step, from 0."""
    total: int
    """The number of steps of the whole run."""
    view: TrainingView
    """The view that the step renders, as `training_views` returned it."""
    log: dict[str, float] = field(default_factory=dict, compare=False)
    """Values that components record, by column names `<component>.<quantity>`. A row of history.csv
    has the mean of each column over the steps since the row before that recorded it."""

    @property
    def nominal(self) -> float:
        """The position of the step in a run of 30,000 steps, in which schedules are written."""
        return self.number * NOMINAL_STEPS / self.total


class ViewRenderer(Protocol):
    """Renders training views for components (`xrgs.training.rendering.StepRenderer`).

    Its work and its time count as the run's.
    """

    def photograph(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Render the step's view as it is compared with its photograph: [H, W, 3], no graph."""

    def attribute(self, pixels: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Sum a map [H, W] of the step's view over the weights of each Gaussian in it: [N]."""


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
        """Take the renderer, for a component that renders other views than the step's own.

        Training calls it once, before the first step or the first step after a checkpoint.

        Args:
            renderer: Renders any training view with all components of the run.
        """

    def allows_view(self, step: Step) -> bool:
        """Decide whether training may sample the step's view at that step.

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

        All later hooks see a view of the result as the step's view. The result must depend on the
        number of the step alone, so that a continued run has the same views.

        Args:
            views: All training views by name, as the components before this one changed them.
            step: The step with the sampled view.

        Returns:
            Views of the same names and tags, each with a photograph of its camera's size. They are
            `views` itself if nothing is changed, and the same object as at the step before if
            nothing has changed since. The loss prepares the photographs anew for another object.
        """
        del step
        return views

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        """Change the Gaussians for this step's render alone.

        Args:
            activated: N Gaussians with scales in world units and opacities in 0..1.
            step: The step with its view.

        Returns:
            The N Gaussians to render, differentiable in `activated`.
        """
        del step
        return activated

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Choose the camera that the step's view is rendered with.

        Args:
            camera: The camera of the view, as the components before this one changed it.
            step: The step with its view.

        Returns:
            A camera with the same view, of any size in px.
        """
        del step
        return camera

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Bring a render to the size of the photograph, as the photograph was formed.

        A component that changes the size in `render_camera` restores it here. Components are called
        in reverse order.

        Args:
            image: The render [h, w, 3], as the components after this one changed it.
            step: The step with its view.

        Returns:
            The image [H, W, 3] at the photograph's size, linear in `image`.
        """
        del step
        return image

    def match_colors(self, image: Tensor, step: Step) -> Tensor:
        """Bring the colours of a render to those that its photograph has been taken with.

        Training calls it for the render of the step with gradients enabled, and for renders of
        other views that components ask for without.

        Args:
            image: [H, W, 3] after `to_photograph`.
            step: The step with its view.

        Returns:
            The image [H, W, 3] that is compared with the photograph, made pixel by pixel.
        """
        del step
        return image

    def pixel_weights(self, step: Step) -> Tensor | None:
        """Return weights [H, W] of the pixels in the photometric loss; None if all are 1."""
        del step
        return None

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Change the loss before backward, by a further term or a factor.

        Args:
            loss: Scalar; the photometric loss, as the components before this one changed it.
            image: [H, W, 3] render of the view as it is compared with the photograph, not clamped
                to 0..1. Outside the view's mask it is the photograph.
            gaussians: The N trained Gaussians; a term may depend on their parameters.
            step: The step with its view.

        Returns:
            The changed loss, a scalar.
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
            statistics of densification. Schedules go on, the decay of the learning rate too.
        """
        del loss, step
        return True

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Change the gradients of the parameters in place, before the optimizer reads them.

        Args:
            gaussians: N Gaussians with their gradients. A change of the gradient of `shN` has no
                effect: the optimizer computes it from the gradient of `sh0`.
            step: The step with its view.
        """

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Change the image-plane gradient that densification averages, and nothing else.

        Args:
            grad2d: [N, 2] gradient of the loss with respect to the projected means, per pixel.
            step: The step with its view.

        Returns:
            The gradient [N, 2] for densification.
        """
        del step
        return grad2d

    def densification_groups(self, settings: DensifySettings) -> Groups | None:
        """Return thresholds of densification and pruning by the views' tags, or None.

        Training calls it once, before the first step. At most one component may return groups.

        Args:
            settings: The settings of densification.
        """
        del settings
        return None

    def may_grow(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Choose which of the Gaussians above the growth threshold may grow.

        Training calls it at refinements, before anything grows.

        Returns:
            [N] bool, or None if all Gaussians may grow.
        """
        del gaussians, step
        return None

    def growth_scores(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Rank the Gaussians that would grow where a budget leaves room for some of them.

        Training calls it at such refinements alone, before anything grows. The Gaussians with the
        highest scores grow.

        Returns:
            Scores [N] of at least 0; None ranks by the mean image-plane gradient.
        """
        del gaussians, step
        return None

    def to_prune(self, gaussians: Gaussians, step: Step) -> Tensor | None:
        """Choose further Gaussians to remove.

        Training calls it in every step, also after densification has stopped. If densification
        changed the Gaussians in this step, `on_gaussians_changed` was called before.

        Returns:
            [N] bool, or None if all Gaussians stay.
        """
        del gaussians, step
        return None

    def after_step(self, gaussians: Gaussians, step: Step) -> None:
        """Change the values of the Gaussians in place, when all else of the step is done.

        The optimizer's moments stay as they are.
        """

    def opacity_attenuation(self, gaussians: Gaussians) -> Tensor | None:
        """Tell by which factors `before_render` lowers opacities in every view.

        Training calls it when it resets opacities. If the step was a refinement too,
        `on_gaussians_changed` has not been called yet.

        Returns:
            Factors [N] above 0 and at most 1, or None if opacities are not lowered.
        """
        del gaussians
        return None

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        """Update what depends on the number and the order of the Gaussians.

        Training calls it before the first step, and whenever densification or `to_prune` has
        added, removed or reset Gaussians.
        """

    def bake(self, gaussians: Gaussians) -> None:
        """Apply to the Gaussians, in place, what `before_render` does in every view.

        Training calls it on the trained Gaussians before they are saved, and on a copy of the
        Gaussians whenever they are evaluated during training.
        """

    def after_training(self, gaussians: Gaussians) -> None:
        """Look at the trained Gaussians before they are saved."""

    def findings(self) -> list[str]:
        """Return what training has found out about the photographs, for the cell's summary.

        Returns:
            Lines for people; each begins with the component's name, as in `floaters: ...`.
        """
        return []

    def state_dict(self) -> dict[str, Any]:
        """Return what the steps so far have changed in the component, for a checkpoint.

        Returns:
            Tensors and JSON values by name; empty if there is no state.
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
    """Raise XrgsError, naming the key of the config, unless a value is finite and at least 0."""
    if not (math.isfinite(value) and value >= 0):
        raise XrgsError(f"{key}={value}: must be a finite number, 0 or more")
