"""Counts the work of training steps, and the skipped work."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from xrgs.splat.sh import bases

if TYPE_CHECKING:
    from collections.abc import Iterable

    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.rendering import Render
    from xrgs.training.checkpoint import State
    from xrgs.training.components import Step, TrainingView


class StepWork:
    """Totals of the work that steps did and skipped.

    All counts except the number of visible Gaussians are available without extra computation.

    Attributes:
        photographs: View name -> number of pixels of its photograph.
        counts: Name -> total over the steps.
        views: Names of the views that were trained on.
    """

    def __init__(self, views: Iterable[TrainingView]) -> None:
        """Start with nothing counted.

        Args:
            views: All training views, with the cameras of their photographs.
        """
        self.photographs = {v.name: v.camera.width * v.camera.height for v in views}
        self.counts: Counter[str] = Counter()
        self.views: set[str] = set()

    def add(self, step: Step, render: Render, gaussians: Gaussians, sh_degree: int) -> None:
        """Count a step.

        Args:
            step: The step.
            render: Its render.
            gaussians: The N Gaussians that were rendered.
            sh_degree: Highest band of the spherical harmonics that was rendered.
        """
        visible, pixels = int(render.visible.count_nonzero()), render.alpha.numel()
        photograph = self.photographs[step.view.name]
        stored = gaussians.shN.shape[1] + 1
        self.views.add(step.view.name)
        self.counts.update(
            gaussians=len(gaussians),
            gaussians_visible=visible,
            pixels=pixels,
            pixels_photograph=photograph,
            pixels_left_out=max(0, photograph - pixels),
            pairs=len(gaussians) * pixels,
            pairs_visible=visible * pixels,
            pairs_in_tiles=render.tile_evaluations,
            sh_coefficients=visible * stored,
            sh_coefficients_left_out=visible * (stored - bases(sh_degree)),
        )

    def totals(self) -> dict[str, int]:
        """Return the totals over all steps.

        Returns:
            - `views`: number of views that were trained on; all other counts are sums over steps;
            - `gaussians`, `gaussians_visible`;
            - `pixels` of the renders, `pixels_photograph` of the photographs, and
              `pixels_left_out`, the pixels that smaller renders saved;
            - `pairs` of a pixel and a Gaussian, `pairs_visible` of a pixel and a visible Gaussian,
              `pairs_in_tiles` (`Render.tile_evaluations`);
            - `sh_coefficients` of visible Gaussians, and `sh_coefficients_left_out` of bands that
              were not on.
        """
        return {"views": len(self.views)} | dict(self.counts)

    def state_dict(self) -> State:
        """Return the totals so far."""
        return {"counts": dict(self.counts), "views": sorted(self.views)}

    def load_state_dict(self, state: State) -> None:
        """Continue a run of the same config and data."""
        self.counts = Counter(state["counts"])
        self.views = set(state["views"])
