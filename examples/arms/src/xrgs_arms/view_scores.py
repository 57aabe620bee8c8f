"""Scores of Gaussians by several training views, which decide what densification grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from xrgs.errors import XrgsError
from xrgs.training.components import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    ViewRenderer,
    check_not_negative,
)
from xrgs.training.seeding import seeded_generator

if TYPE_CHECKING:
    from xrgs.splat.gaussians import Gaussians


@dataclass
class MultiviewSettings:
    """The keys under `components.plugins.multiview_score` of the config."""

    views: int = 0
    """Number of training views for the scores of each refinement; 0 is off; FastGS has 10."""
    error: float = 0.1
    """An error is high if it is above this share of a view's largest error; FastGS's value."""
    pixels: float = 0.0
    """A Gaussian may grow if it shows more pixels with a high error than this, weighted as they are
    blended, px^2 of the finest view. FastGS counts pixels without a weight and has 5."""


@dataclass
class ErrorSettings:
    """The keys under `components.plugins.error_score` of the config."""

    of: str = "nothing"
    """The score that ranks Gaussians: the `edges` of the photographs or the `errors` of the renders
    that they show, or `nothing` (off: the image-plane gradient ranks them)."""
    views: int = 10
    """Number of training views for the scores of each refinement; Improved-GS's value."""


class _ViewScores(Component):
    """Computes for each Gaussian the mean of its scores in some training views.

    The views are drawn at each refinement, from all training views without repetition. They are
    rendered with all components of the run; their alpha evaluations and time count for the run.
    """

    renderer: ViewRenderer

    def __init__(self, views: Sequence[TrainingView], count: int, seed: int) -> None:
        self.views, self.count, self.seed = views, min(count, len(views)), seed

    def before_training(self, renderer: ViewRenderer) -> None:
        """Store the renderer of views."""
        self.renderer = renderer

    def score_in_view(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Return the scores [N] of the Gaussians in the step's view."""
        raise NotImplementedError

    def scores(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Return the mean scores [N] over the views of a refinement."""
        # The draw depends only on seed and step, so that a checkpoint needs no state.
        generator = seeded_generator(self.seed, f"{type(self).__name__} {step.number}")
        total = gaussians.opacities.new_zeros(len(gaussians))
        for index in torch.randperm(len(self.views), generator=generator)[: self.count].tolist():
            total += self.score_in_view(gaussians, Step(step.number, step.total, self.views[index]))
        return total / self.count


class MultiviewScore(_ViewScores):
    """Lets a Gaussian grow only if it shows many pixels with a high error, in the mean of views.

    Multi-view consistent densification [ren2025fastgs]. In each of `views` training views, the
    absolute difference between render and photograph, averaged over the channels, is scaled to 0..1
    by its smallest and largest value in the view. A pixel's error is high if the result is above
    `error`. A Gaussian above the growth threshold may grow if

        s_i = mean over the views of  (1 / rho^2) sum over p of [error of p is high] w_i(p)
            > pixels

    where w_i(p) is the weight with which Gaussian i is blended into pixel p (`attribute_pixels`).

    Ours: FastGS counts the pixels of the footprint without weights, and demands more than 5 pixels.
    A sum of weights needs no extra kernel, and does not blame a Gaussian that is faint or hidden in
    a pixel for its error. The sum is a few hundredths of the count, so that `pixels` is far below
    5. rho is the sampling rate of the view relative to the finest view
    (`TrainingView.sampling_rate`), so that the sum is in px^2 of the finest view: a pixel of an LR
    view that is 5 times smaller counts 25.

    FastGS's pruning is left out. Four times after densification it removes Gaussians with an
    opacity below 0.1, and those with more than 0.9 of the largest sum of such scores, each times
    the view's loss. In our trials the score chose one or two Gaussians at a time, and a lower share
    than 0.9 cost quality. Nearly all were chosen by their opacity, and `natural_selection` is the
    component for removing transparent Gaussians after densification.
    """

    settings_type = MultiviewSettings

    def __init__(
        self, settings: MultiviewSettings, views: Sequence[TrainingView], seed: int
    ) -> None:
        """Take the settings, all training views and the seed of the run."""
        super().__init__(views, settings.views, seed)
        self.error, self.pixels = settings.error, settings.pixels

    @classmethod
    def from_settings(cls, settings: MultiviewSettings, setup: TrainingSetup) -> Self | None:
        """Build the component; 0 `views` leave it off.

        Raises:
            XrgsError: A value is below 0, or the error above 1.
        """
        for name in ("views", "error", "pixels"):
            check_not_negative(
                f"components.plugins.multiview_score.{name}", getattr(settings, name)
            )
        if settings.error >= 1:
            raise XrgsError(
                f"components.plugins.multiview_score.error={settings.error}: must be below 1"
            )
        return cls(settings, setup.data.train, setup.seed) if settings.views else None

    def may_grow(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Return which Gaussians [N] show enough pixels with a high error."""
        return self.scores(gaussians, step) > self.pixels

    def score_in_view(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Return the weighted number [N] of pixels with a high error, px^2 of the finest view."""
        error = _mean_error(self.renderer.photograph(gaussians, step), step.view.image)
        high = _in_unit_range(error, step.view.mask) > self.error
        sums = self.renderer.attribute(high.to(error), gaussians, step)
        return sums / step.view.sampling_rate**2


class ErrorScore(_ViewScores):
    """Ranks the Gaussians that would grow by the edges or errors that they show in some views.

    If a budget leaves room for only some of the Gaussians above the growth threshold, the Gaussians
    with the highest scores grow. The score is the edge-aware score of Improved-GS [deng2025], as in
    the authors' code:

        s_i = mean over the views j of  a_ij / (mean of a_kj over the k with a_kj > 0),
        a_ij = sum over p of e_j(p) w_i(p)

    where w_i(p) is the weight with which Gaussian i is blended into pixel p (`attribute_pixels`).
    Each view has the same mean score, so that HR and LR views count alike. The map e_j is one of

    - `edges`: the absolute Laplacian of the photograph's brightness, over 3 x 3 pixels, scaled to
      0..1 by its smallest and largest value in the view;
    - `errors`, ours: the absolute difference between the render and the photograph, averaged over
      the channels.

    Also ours: the Laplacian's absolute value, while the authors' image library clips negative
    values; and the highest scores grow, instead of a random choice weighted by the scores.
    """

    settings_type = ErrorSettings

    def __init__(self, settings: ErrorSettings, views: Sequence[TrainingView], seed: int) -> None:
        """Take the settings, all training views and the seed of the run."""
        super().__init__(views, settings.views, seed)
        self.of = settings.of

    @classmethod
    def from_settings(cls, settings: ErrorSettings, setup: TrainingSetup) -> Self | None:
        """Build the component; `of: nothing` leaves it off.

        Raises:
            XrgsError: `of` is unknown, or there are no views.
        """
        key = "components.plugins.error_score"
        if settings.of not in ("nothing", "edges", "errors"):
            raise XrgsError(f"{key}.of={settings.of}: must be nothing, edges or errors")
        if settings.views < 1:
            raise XrgsError(f"{key}.views={settings.views}: must be at least 1")
        return None if settings.of == "nothing" else cls(settings, setup.data.train, setup.seed)

    def growth_scores(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Return the scores [N] by which Gaussians are ranked; their mean is about 1."""
        return self.scores(gaussians, step)

    def score_in_view(self, gaussians: Gaussians, step: Step) -> Tensor:
        """Return the sums a_ij [N] over the view's map, divided by the mean of positive sums."""
        if self.of == "edges":
            pixels = _in_unit_range(edges(step.view.image), step.view.mask)
        else:
            pixels = _mean_error(self.renderer.photograph(gaussians, step), step.view.image)
        # Downsampling a render gives some pixels negative weights.
        sums = self.renderer.attribute(pixels, gaussians, step).clamp_min(0)
        shown = sums > 0
        mean = sums.sum(dtype=torch.float64) / shown.sum().clamp_min(1)
        return sums / mean.clamp_min(torch.finfo(sums.dtype).tiny).to(sums)


def edges(image: Tensor) -> Tensor:
    """Return the absolute Laplacian of an image's brightness.

    The brightness of a pixel is the sum of its channels. The Laplacian is 8 times the brightness
    less the brightness of the 8 neighbours. The outermost pixels are repeated beyond the border.

    Args:
        image: [H, W, 3].

    Returns:
        [H, W], 0 and up.
    """
    height, width = image.shape[:2]
    grey = image[..., 0] + image[..., 1] + image[..., 2]
    wide = pad(grey[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    total = torch.zeros_like(grey)
    for y in range(3):
        for x in range(3):
            total = total + wide[y : y + height, x : x + width]
    return (9 * grey - total).abs()


def _mean_error(image: Tensor, photograph: Tensor) -> Tensor:
    """Return the absolute difference of two images [H, W, 3], averaged over channels: [H, W]."""
    error = (image - photograph).abs()
    # Written out: the order in which torch adds depends on the processor.
    return (error[..., 0] + error[..., 1] + error[..., 2]) / 3


def _in_unit_range(values: Tensor, mask: Tensor | None) -> Tensor:
    """Scale values [H, W] to 0..1 by the smallest and the largest; all 0 if they are equal.

    Values outside the mask become 0, and are ignored for the smallest and the largest.
    """
    used = values if mask is None else values[mask]
    low, high = used.min(), used.max()
    scaled = (values - low) / (high - low).clamp_min(torch.finfo(values.dtype).tiny)
    return scaled if mask is None else scaled.where(mask, scaled.new_zeros(()))
