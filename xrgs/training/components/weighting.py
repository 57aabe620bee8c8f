"""The weight of a view in the loss [xrgs, sections 5.2 and 7.2].

`Weighting` is the component. Each function below it computes a weight or an attenuation for one
key of the config.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import TYPE_CHECKING, Self

import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from xrgs.errors import XrgsError
from xrgs.splat.rounding import rounded_mean, rounded_sqrt
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView
from xrgs.training.memory import OnDemand

if TYPE_CHECKING:
    from xrgs.config import LossWeightingConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians


WINDOW = 5
"""Side of the square over which the texture of a pixel is averaged, px."""
NEAREST_POINTS = 5
"""Number of nearest SfM points whose median depth is the depth of a pixel."""

ViewWeight = Callable[[TrainingView], float]
"""Function: view -> its lowest weight, in 0..1, which depends only on its resolution."""
Attenuation = Callable[[Step], float]
"""Function: step -> the fraction, in 0..1, of the reduction `1 - view_weight` that applies."""


class Weighting(Component):
    """Multiplies the loss of a view, and so its gradients, by the weight of the view.

        weight = view_weight + (1 - view_weight) (1 - a_1 a_2 ...)

    `view_weight` is the weight by tag of loss weighting (`weight_by_tag`), or, if that is on, the
    weight by sampling rate of continuous weighting (`weight_by_sampling_rate`). The attenuations a
    in 0..1 come from adaptive weighting (`scene_attenuation`), the hybrid schedule
    (`scheduled_attenuation`) and region weighting (`region_attenuations`). An attenuation of 1
    applies the whole reduction, 0 none.

    Our choice where the paper is silent: the paper proposes these methods separately. We multiply
    the attenuations, so that methods can be combined and every weight is between `view_weight` and
    1.

    Region weighting has an attenuation for every pixel. Then `weight` is the mean over the view's
    pixels, and `pixel_weights` distributes it over them. `weighting.<tag>` records the weight of
    each view whose `view_weight` is not 1.
    """

    def __init__(
        self,
        view_weight: ViewWeight,
        attenuations: Sequence[Attenuation] = (),
        regions: Mapping[str, Tensor] | None = None,
        *,
        stat_from: str = "weighted",
    ) -> None:
        """Combine a weight with its attenuations, all of them in 0..1.

        Args:
            view_weight: Returns the lowest weight of a view.
            attenuations: Functions that return an attenuation at a step.
            regions: View name -> attenuations of its pixels [H, W].
            stat_from: `weighted`, or `unweighted` for densification without the weights.
        """
        self.view_weight = view_weight
        self.attenuations = attenuations
        self.regions = regions or {}
        self.region_means = {name: rounded_mean(region) for name, region in self.regions.items()}
        self.stat_from = stat_from

    @classmethod
    def from_settings(cls, settings: LossWeightingConf, setup: TrainingSetup) -> Self | None:
        """Build the component from `loss_weighting` and the settings that change its weight.

        The component is off if every view has weight 1: `lr_weight` is 1, and `gamma` of continuous
        weighting is 0.

        Raises:
            XrgsError: A setting attenuates weights that are all 1.
        """
        conf, data = setup.components, setup.data
        gamma = conf.continuous_weighting.gamma
        off = gamma == 0 and settings.lr_weight == 1
        for key, value in (
            ("components.adaptive_weighting.texture", conf.adaptive_weighting.texture),
            ("components.region_weighting.texture", conf.region_weighting.texture),
            ("components.hybrid_schedule.ramp", conf.hybrid_schedule.ramp),
        ):
            if off and value != 0:
                raise XrgsError(
                    f"{key}={value}: this raises the weight of LR views, which is 1 already; set"
                    " components.loss_weighting.lr_weight or components.continuous_weighting.gamma"
                    " too"
                )
        if off:
            return None
        view_weight: ViewWeight = (
            partial(weight_by_sampling_rate, gamma=gamma)  # it replaces the weight by tag
            if gamma != 0
            else partial(weight_by_tag, lr_weight=settings.lr_weight)
        )
        attenuations: list[Attenuation] = []
        if conf.adaptive_weighting.texture != 0:
            of_scene = scene_attenuation(data.train, conf.adaptive_weighting.texture)
            attenuations.append(lambda _: of_scene)
        if conf.hybrid_schedule.ramp != 0:
            start, ramp = setup.splat.densify.stop, conf.hybrid_schedule.ramp
            attenuations.append(partial(scheduled_attenuation, start=start, ramp=ramp))
        regions = None
        if conf.region_weighting.texture != 0:
            texture, near = conf.region_weighting.texture, setup.splat.raster.near
            regions = region_attenuations(data.train, data.points, texture=texture, near=near)
        return cls(view_weight, attenuations, regions, stat_from=settings.stat_from)

    def weight(self, step: Step) -> float:
        """Return the weight of the step's view: the mean over its pixels."""
        region_mean = self.region_means.get(step.view.name, 1.0)
        view_weight = self.view_weight(step.view)
        return view_weight + (1 - view_weight) * (1 - self._attenuation(step) * region_mean)

    def pixel_weights(self, step: Step) -> Tensor | None:
        """Return the pixels' weights divided by their mean [H, W]; None if all are equal."""
        region = self.regions.get(step.view.name)
        mean = self.weight(step)
        # With a mean of 0 every pixel has weight 0.
        if region is None or mean == 0:
            return None
        view_weight = self.view_weight(step.view)
        return (view_weight + (1 - view_weight) * (1 - self._attenuation(step) * region)) / mean

    def modify_loss(self, loss: Tensor, image: Tensor, gaussians: Gaussians, step: Step) -> Tensor:
        """Return `loss * weight`, or `loss` itself if the weight is 1."""
        weight = self.weight(step)
        if self.view_weight(step.view) != 1:
            step.log[f"weighting.{step.view.tag}"] = weight
        return loss if weight == 1 else loss * weight

    def densification_grad2d(self, grad2d: Tensor, step: Step) -> Tensor:
        """Return the gradient, divided by the view's weight if `stat_from` is `unweighted`."""
        weight = self.weight(step)
        if self.stat_from == "weighted" or weight in {0, 1}:
            return grad2d
        return grad2d / weight

    def _attenuation(self, step: Step) -> float:
        return prod(attenuation(step) for attenuation in self.attenuations)


def weight_by_tag(view: TrainingView, lr_weight: float) -> float:
    """Weight a view by its tag: loss weighting [xrgs, section 5.2].

    Section 5.2 of the paper multiplies the loss of a view:

        L = 1.0 L_base for an HR view, 0.25 L_base for an LR view.

    The weight has two effects. It scales the view's image-plane gradients, and so changes which
    Gaussians grow. And it balances LR and HR views where both see the same Gaussians. Gaussians
    that only LR views see move as fast as without a weight, since Adam [kingma2015] divides a
    gradient by its recent size.

    Our choice where the paper is silent: densification reads the gradients of the weighted loss
    (`stat_from: weighted`), following the formula. With `stat_from: unweighted` it reads the
    gradients without the weight, which does not work for a weight of 0.
    """
    return lr_weight if view.tag == "LR" else 1.0


def weight_by_sampling_rate(view: TrainingView, gamma: float) -> float:
    """Weight a view of either tag by its sampling rate, `rho ** gamma` [xrgs, conclusion].

    `rho`, in (0, 1], is the sampling rate of the view (focal length in px over the median depth of
    the scene) divided by the highest rate of all views. For synthetic LR views it is about
    1 / factor; for real photographs it depends on focal length and distance. For a view degraded at
    full size, it is the rate of the full size.

    Our choice where the paper is silent: the conclusion proposes "a continuous, texture-aware
    weighting scheme" and gives no formula. The power law is ours. gamma = 0.86, log 4 / log 5,
    gives an LR view at factor 5 the paper's weight of 0.25. (For a power of the number of pixels,
    which is proportional to rho squared, gamma would be 0.43.)
    """
    return float(view.sampling_rate**gamma)


def scene_attenuation(views: Sequence[TrainingView], texture: float) -> float:
    """Attenuate LR views in proportion to the texture of the scene [xrgs, 7.2, proposal 1].

    Adaptive weighting: the attenuation is `min(1, g / texture)`, where g is the mean of
    `gradient_magnitude` over all used pixels of all LR views. It is 0 for a flat scene, whose LR
    views lack no detail, and 1 from g = `texture` on.

    Our choice where the paper is silent: section 7.2 proposes to "estimate image texture (e.g., via
    Fourier or gradient magnitude) and increase LR weighting when the scene is globally
    low-frequency", without a measure or weights. Measure, ramp and threshold are ours. `texture` of
    0.07 is between g of the LLFF scenes that the paper calls cluttered (fern, flower, horns: 0.074
    to 0.12 at factor 5 of 504 and 1008 px) and of the simple ones (fortress 0.055; a single object
    0.03 to 0.04). `texture` is an intensity per px.
    """
    magnitudes = [mean_gradient(v.image, v.mask) for v in views if v.tag == "LR"]
    mean = sum(magnitudes) / len(magnitudes) if magnitudes else 0.0
    return min(1.0, mean / texture)


def scheduled_attenuation(step: Step, start: float, ramp: float) -> float:
    """Attenuate LR views until densification stops, then less and less [xrgs, 7.2, proposal 3].

    The hybrid schedule: the attenuation is 1 until `start` and falls linearly to 0 over the next
    `ramp` steps.

    Our choice where the paper is silent: section 7.2 proposes to "reintroduce LR influence in late
    training stages" and names no step. We start at the end of densification: from then on LR views
    can refine the Gaussians that HR views have shaped, but can't create new ones. `start` and
    `ramp` are in steps of a 30,000-step run.
    """
    return 1 - min(1.0, max(0.0, (step.nominal - start) / ramp))


def region_attenuations(
    views: Sequence[TrainingView], points: Tensor, *, texture: float, near: float
) -> Mapping[str, Tensor]:
    """Attenuate textured parts of LR views that an HR view covers [xrgs, 7.2, proposal 2].

    Region weighting: with g, `gradient_magnitude` averaged over 5 x 5 px, the attenuation of a
    pixel is `min(1, g / texture)` if an HR view covers it (`coverage`), else 0. Smooth regions, and
    regions that no HR view sees, keep the full weight.

    Our choice where the paper is silent: section 7.2 proposes "spatially varying loss/gradient
    scaling so smooth regions retain LR supervision while textured regions benefit from XR-GS
    attenuation". The measure, its window and the condition of coverage are ours; `texture` is 0.07
    per px as in adaptive weighting. `points` and `near` are as for `coverage`.

    Returns:
        Name of each LR view -> attenuations [H, W] in 0..1.
    """
    hr_cameras = [view.camera for view in views if view.tag == "HR"]
    low = [view for view in views if view.tag == "LR"]
    covered = {view.name: coverage(view.camera, hr_cameras, points, near) for view in low}
    return OnDemand(_RegionAttenuation(covered, texture), low)


@dataclass(frozen=True)
class _RegionAttenuation:
    """Computes the attenuations of a view from its coverage, which is cached since it is slow."""

    covered: Mapping[str, Tensor]
    """Name of each LR view -> [H, W] bool, whether an HR view covers the pixel."""
    texture: float

    def __call__(self, view: TrainingView) -> Tensor:
        share = _box_mean(gradient_magnitude(view.image), view.mask) / self.texture
        attenuation = share.clamp_max(1.0) * self.covered[view.name].to(share.device)
        if view.mask is None:
            return attenuation
        # Pixels outside the mask have no loss. Filled with the mean of the used pixels, they do not
        # change the mean of the view.
        inside = rounded_mean(attenuation[view.mask])
        return attenuation.where(view.mask, attenuation.new_tensor(inside))


def coverage(camera: Camera, others: Sequence[Camera], points: Tensor, near: float) -> Tensor:
    """Find the pixels of a view whose content another view samples more finely.

    The depth of a pixel is the median depth of the five SfM points that project nearest to it. The
    pixel is covered if its point at that depth projects into one of the other views, at more px per
    world unit than in its view. Occlusion is not tested, since a few points per view can't resolve
    depth edges: content that an object hides from every other view counts as covered.

    Args:
        camera: The view.
        others: The other views.
        points: [P, 3] SfM points, world units.
        near: Depth below which a point is not seen, world units.

    Returns:
        [H, W] bool; False everywhere if no point projects into the view.
    """
    depth = _pixel_depths(camera, points, near)
    if depth is None:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    x, y = _pixel_centres(camera).unbind(-1)
    K = camera.K.to(points)
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    viewmat = camera.viewmat.to(points)
    # The product with the transposed rotation, without a matrix product, since the order in which
    # torch adds depends on the processor.
    at_depth = (rays * depth[:, None] - viewmat[:3, 3])[..., None] * viewmat[:3, :3]
    world = at_depth[:, 0] + at_depth[:, 1] + at_depth[:, 2]  # [H W, 3]
    covered = torch.zeros(len(world), dtype=torch.bool)
    for other in others:
        pixels, z = _project(other, world)
        finer = other.K[0, 0] / z > K[0, 0] / depth
        covered |= (z > near) & _inside(pixels, other) & finer
    return covered.reshape(camera.height, camera.width)


def _pixel_depths(camera: Camera, points: Tensor, near: float) -> Tensor | None:
    """Return the depth of each pixel [H W], in row-major order; None if no point is in view."""
    pixels, z = _project(camera, points)
    seen = (z > near) & _inside(pixels, camera)
    count = int(seen.sum())
    if count == 0:
        return None
    ranks = range(1, min(NEAREST_POINTS, count) + 1)
    tree = KDTree(pixels[seen].numpy())
    _, nearest = tree.query(_pixel_centres(camera).numpy(), k=ranks)  # [H W, k]
    return z[seen][torch.from_numpy(nearest)].median(dim=1).values


def _pixel_centres(camera: Camera) -> Tensor:
    """Return the centres [H W, 2] of the pixels, x and y, px, in row-major order."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5


def _project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return projections [P, 2], px, and depths [P] of points [P, 3] with depths above 0."""
    K = camera.K.to(points)
    x, y, z = camera.to_camera(points)
    pixels = torch.stack([x, y], dim=-1) / z[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels, z


def _inside(pixels: Tensor, camera: Camera) -> Tensor:
    """Return whether each of the pixels [P, 2] is inside the image."""
    return ((pixels > 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))).all(dim=-1)


def _box_mean(values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean [H, W] over the pixels of each window that are inside image and mask."""
    if mask is not None:
        used = mask.to(values)
        return _box_mean(values * used) / _box_mean(used).clamp_min(torch.finfo(values.dtype).tiny)
    pooled = avg_pool2d(
        values[None, None], WINDOW, stride=1, padding=WINDOW // 2, count_include_pad=False
    )
    mean: Tensor = pooled[0, 0]
    return mean


def gradient_magnitude(image: Tensor) -> Tensor:
    """Compute the magnitude of the image gradient at each pixel.

    With forward differences d_x and d_y of each of the three channels,

        g = sqrt(mean over channels of (d_x^2 + d_y^2)).

    The unit of length is a pixel, so g measures detail near the limit of the image's resolution. In
    an LR view, a large g indicates that detail is missing.

    Our choice where the paper is silent: section 7.2 says only "via Fourier or gradient magnitude".

    Args:
        image: [H, W, 3] in 0..1, at least 2 x 2 px.

    Returns:
        [H, W] intensity per px, at most sqrt(2); the last row and column are copies of their
        neighbours.
    """
    inner = image[:-1, :-1]
    squared = (image[:-1, 1:] - inner).square() + (image[1:, :-1] - inner).square()
    red, green, blue = squared.unbind(-1)
    magnitude = rounded_sqrt((red + green + blue) / 3)  # [H - 1, W - 1]
    return pad(magnitude[None], (0, 1, 0, 1), mode="replicate")[0]


def mean_gradient(image: Tensor, mask: Tensor | None) -> float:
    """Average `gradient_magnitude` over an image, or over the used pixels of its mask.

    A used pixel counts only if its right and lower neighbours are used too, since the differences
    read them.

    Args:
        image: [H, W, 3] in 0..1, at least 2 x 2 px.
        mask: [H, W] bool, True for a used pixel; None uses all.

    Returns:
        Intensity per px; 0 if no pixel counts.
    """
    magnitude = gradient_magnitude(image)
    if mask is None:
        return rounded_mean(magnitude)
    known = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]
    return rounded_mean(magnitude[:-1, :-1][known]) if known.any() else 0.0
