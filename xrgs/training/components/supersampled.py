"""LR views rendered as their photographs were formed: larger, and then brought down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class _Formation:
    """How the photograph of an LR view was formed from a finer image of the same camera."""

    camera: Camera
    """The camera at the size of the pixels that the photograph resolves."""
    width: int
    """Width of the photograph, px; a digital zoom has more pixels than it resolves."""
    height: int
    """Height of the photograph, px."""


class Supersampled(Component):
    """Renders LR views at a larger size, and brings the render down as the photograph was.

    An LR photograph is I = D(S): a finer image S of the same camera, brought down by a kernel D.
    gsplat [ye2025] renders the view at the size of I, where the filter of `splat.raster.eps2d`,
    0.3 px^2 of that size, is `factor`^2 times as large in pixels of an HR view. Here the view is
    rendered at k times the width and height, and

        loss = L(D(render_k), I)

    is the loss of the view, with D the kernel by which the variant has made its LR views:

    - `downsample`: antialiased bicubic to the size of I;
    - `digital_zoom`: the same to the size between, which is the size that I resolves, and bicubic
      up again; the render is k times as large as the size between;
    - `none`, for LR views that a camera took: the mean of k x k pixels, since a pixel of a sensor
      averages over its area.

    `jpeg` has all the pixels of an HR view, and nothing to supersample.

    With `components.formation`, D is learned in place of that (`BlurWidths`), and acts where k is 1
    too; a digital zoom comes after it.

    k is `factor` before step `late_from` and `late_factor` from there on, so that a run may begin
    or end with direct renders (k = 1). Densification reads the image-plane gradients of the larger
    render in normalised device units, which do not depend on its size. HR views and the evaluation
    are untouched.

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
        """Find out how the photograph of each LR view was formed.

        Args:
            settings: `components.supersampled` of the config.
            views: All training views.
            degradation: What was done to LR views: `downsample`, `digital_zoom`, `none`.
            zoom: With `digital_zoom`, how many times fewer px per side a photograph resolves.
            backend: `torch` or `native`: the implementation of the resampling.
            blur: `components.formation` of the config.
        """
        self.settings = settings
        self.backend = backend
        self.averages = degradation == "none"
        resolved = zoom if degradation == "digital_zoom" else 1
        self.formations = {
            view.name: _Formation(
                view.camera.resized(view.camera.width // resolved, view.camera.height // resolved),
                view.camera.width,
                view.camera.height,
            )
            for view in views
            if view.tag == "LR"
        }
        low = [view for view in views if view.tag == "LR"]
        self.blur = BlurWidths(blur, low) if blur.widths != "none" else None

    @classmethod
    def from_settings(cls, settings: SupersampledConf, setup: TrainingSetup) -> Self | None:
        """Build the component; factors of 1 with no `formation.widths` leave it off.

        Raises:
            XrgsError: A value is out of its range, or LR views of the variant that are compressed
                ones shall be supersampled.
        """
        blur = setup.components.formation
        if blur.widths not in ("none", "tag", "view"):
            raise XrgsError(f"components.formation.widths={blur.widths}: must be none, tag or view")
        for name in ("lr", "prior"):
            check_not_negative(f"components.formation.{name}", getattr(blur, name))
        for name in ("factor", "late_factor"):
            if (value := getattr(settings, name)) < 1:
                raise XrgsError(f"components.supersampled.{name}={value}: must be 1 or more")
        supersamples = not settings.factor == settings.late_factor == 1
        if not supersamples and blur.widths == "none":
            return None
        if supersamples and setup.data.degradation == "jpeg":
            raise XrgsError(
                "components.supersampled: the LR views of variant.degradation=jpeg have as many"
                " pixels as HR views; there is nothing to supersample"
            )
        data = setup.data
        return cls(settings, data.train, data.degradation, data.factor, setup.backend, blur=blur)

    def render_camera(self, camera: Camera, step: Step) -> Camera:
        """Return the camera at k times the size that an LR photograph resolves."""
        formation, factor = self.formations.get(step.view.name), self._factor(step)
        if formation is None or (factor == 1 and self.blur is None):
            return camera
        step.log["supersampled.factor"] = factor
        small = formation.camera
        return small.resized(small.width * factor, small.height * factor)

    def to_photograph(self, image: Tensor, step: Step) -> Tensor:
        """Bring the render [kH, kW, 3] of an LR view down to its photograph's size [H, W, 3]."""
        formation, factor = self.formations.get(step.view.name), self._factor(step)
        if formation is None or (factor == 1 and self.blur is None):
            return image
        if self.averages and self.blur is None:
            return _block_means(image, factor)
        small = formation.camera
        variances = None if self.blur is None else self.blur.variances(step, factor)
        image = resize(image, small.height, small.width, variances=variances, backend=self.backend)
        if (formation.height, formation.width) == (small.height, small.width):
            return image
        return resize(image, formation.height, formation.width, backend=self.backend)

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        """Move the widths of the blur of the step's photograph."""
        del gaussians
        if self.blur is not None:
            self.blur.learn(step)

    def after_training(self, gaussians: Gaussians) -> None:
        """Log the widths of the blur."""
        del gaussians
        if self.blur is not None:
            self.blur.report()

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the blur; empty without one."""
        return {} if self.blur is None else self.blur.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        if self.blur is not None:
            self.blur.load_state_dict(state)

    def _factor(self, step: Step) -> int:
        late = step.nominal >= self.settings.late_from
        return self.settings.late_factor if late else self.settings.factor


def _block_means(image: Tensor, side: int) -> Tensor:
    """Average the blocks of `side` x `side` pixels of an image [side * H, side * W, 3]."""
    # Written out: the order in which torch's pooling adds depends on the processor.
    total = image.new_zeros(())
    for y in range(side):
        for x in range(side):
            total = total + image[y::side, x::side]
    return total / side**2
