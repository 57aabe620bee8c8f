"""Views rendered as their photographs were formed: larger, and then brought down."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.splat.cameras import Camera
from xrgs.splat.resample import resize
from xrgs.training.components.base import (
    Component,
    Step,
    TrainingSetup,
    TrainingView,
    check_not_negative,
)
from xrgs.training.components.formation import BlurWidths

if TYPE_CHECKING:
    from xrgs.config import FormationConf, SupersampledConf
    from xrgs.splat.gaussians import Gaussians


class Supersampled(Component):
    """Renders coarse views at a larger size, and brings the render down as the photograph was.

    The photograph of a coarse view is I = D(S): a finer image S of the same camera, brought down by
    a kernel D. gsplat [ye2025] renders the view at the size of I, where the filter of
    `splat.raster.eps2d`, 0.3 px^2 of that size, is many times as large in pixels of a finer view.
    Here the view v is rendered at k_v times the width and height, and

        loss = L(D(render_k), I),    k_v = clamp(round(need_v), 1, factor)

    is the loss of the view. need_v says how many times as many pixels a side the view would need to
    be as fine as the finest views of what it sees (`xrgs.mixture.sampling_rate.needed_factors`):
    about 1 for an HR view, which stays as it is, and about `variant.factor` for a degraded one. The
    view's tag does not count: photographs that are hardly a mixture are all rendered at their own
    size.

    D is the kernel by which the variant has made its LR views:

    - `downsample`, and other degradations that make a view smaller: antialiased bicubic to the size
      of I;
    - `digital_zoom`: the same to the size between, which is the size that I resolves, and bicubic
      up again; the render is k times as large as the size between.

    For all other views it is the mean of k x k pixels, since a pixel of a sensor averages over its
    area.

    With `components.formation`, D is learned for LR views in place of that (`BlurWidths`), and acts
    where k is 1 too; a digital zoom comes after it.

    `late_factor` takes the place of `factor` from step `late_from` on, so that a run may begin or
    end with direct renders. Densification reads the image-plane gradients of the larger render in
    normalised device units, which do not depend on its size. The evaluation is untouched.

    Our choice: the whole component; super-resolution of 3D Gaussian Splatting trains through a
    downsampled render too [feng2024srgs], but on LR views alone.
    """

    def __init__(
        self,
        settings: SupersampledConf,
        views: Sequence[TrainingView],
        degradation: str,
        zoom: int,
        backend: str = "torch",
        *,
        blur: FormationConf,
    ) -> None:
        """Find out how photographs were formed, and log how many views have each k.

        Args:
            settings: `components.supersampled` of the config.
            views: All training views.
            degradation: What was done to LR views, `Dataset.degradation`.
            zoom: With `digital_zoom`, how many times fewer px per side a photograph resolves.
            backend: `torch` or `native`: the implementation of the resampling.
            blur: `components.formation` of the config.
        """
        self.settings = settings
        self.backend = backend
        self.shrinks = degradation not in ("jpeg", "none")
        """Whether LR views resolve fewer pixels than the photographs that they were made of."""
        self.zoom = zoom if degradation == "digital_zoom" else 1
        low = [view for view in views if view.tag == "LR"]
        self.blur = BlurWidths(blur, low) if blur.widths != "none" else None
        self.needs = [view.supersampling for view in views]

    @classmethod
    def from_settings(cls, settings: SupersampledConf, setup: TrainingSetup) -> Self | None:
        """Build the component; factors of 1 with no `formation.widths` leave it off.

        Raises:
            XrgsError: A value is out of its range.
        """
        blur = setup.components.formation
        if blur.widths not in ("none", "tag", "view"):
            raise XrgsError(f"components.formation.widths={blur.widths}: must be none, tag or view")
        for name in ("lr", "prior"):
            check_not_negative(f"components.formation.{name}", getattr(blur, name))
        for name in ("factor", "late_factor"):
            if (value := getattr(settings, name)) < 1:
                raise XrgsError(f"components.supersampled.{name}={value}: must be 1 or more")
        if settings.factor == settings.late_factor == 1 and blur.widths == "none":
            return None
        data = setup.data
        return cls(settings, data.train, data.degradation, data.factor, setup.backend, blur=blur)

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Return the camera at k times the size that the photograph resolves."""
        factor = self._factor(step)
        if factor == 1 and not self._is_blurred(step):
            return camera
        step.log["supersampled.factor"] = factor
        small = self._resolved(camera, step)
        return small.resized(small.width * factor, small.height * factor)

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Bring the render [kH, kW, 3] of a view down to its photograph's size [H, W, 3]."""
        factor, blur = self._factor(step), self.blur if self._is_blurred(step) else None
        if factor == 1 and blur is None:
            return image
        if blur is None and not (self.shrinks and step.view.tag == "LR"):
            return _block_means(image, factor)
        camera = step.view.camera
        small = self._resolved(camera, step)
        variances = None if blur is None else blur.variances(step, factor)
        image = resize(image, small.height, small.width, variances=variances, backend=self.backend)
        if (camera.height, camera.width) == (small.height, small.width):
            return image
        return resize(image, camera.height, camera.width, backend=self.backend)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Move the widths of the blur of the step's photograph."""
        del gaussians
        if self.blur is not None:
            self.blur.learn(step)

    def findings(self) -> list[str]:
        """Return how many views have each k, and the widths of the blur that were learned."""
        return [self._factors(), *(self.blur.findings() if self.blur is not None else ())]

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the blur; empty without one."""
        return {} if self.blur is None else self.blur.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        if self.blur is not None:
            self.blur.load_state_dict(state)

    def _factor(self, step: Step) -> int:
        """Return k at a step on a view."""
        late = step.nominal >= self.settings.late_from
        settings = self.settings
        return _clamped(step.view.supersampling, settings.late_factor if late else settings.factor)

    def _is_blurred(self, step: Step) -> bool:
        return self.blur is not None and step.view.tag == "LR"

    def _resolved(self, camera: Camera, step: Step) -> Camera:
        """Return the camera of a view at the size of the pixels that its photograph resolves."""
        if self.zoom == 1 or step.view.tag == "HR":
            return camera
        return camera.resized(camera.width // self.zoom, camera.height // self.zoom)

    def _factors(self) -> str:
        """Return how many views have each k, and from `late_from` on, where that differs."""
        settings = self.settings
        early, late = (
            ", ".join(f"{count} at {k}" for k, count in sorted(counts.items()))
            for counts in (
                Counter(_clamped(need, factor) for need in self.needs)
                for factor in (settings.factor, settings.late_factor)
            )
        )
        later = "" if late == early else f"; from step {settings.late_from} on {late}"
        return f"supersampled: views at k times their size: {early}{later}"


def _clamped(need: float, factor: int) -> int:
    return min(max(1, round(need)), factor)


def _block_means(image: Tensor, side: int) -> Tensor:
    """Average the blocks of `side` x `side` pixels of an image [side * H, side * W, 3]."""
    # Written out: the order in which torch's pooling adds depends on the processor.
    total = image.new_zeros(())
    for y in range(side):
        for x in range(side):
            total = total + image[y::side, x::side]
    return total / side**2
