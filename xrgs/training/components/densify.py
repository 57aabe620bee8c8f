"""Resolution-aware densification and pruning (paper 5.4)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.splat.densify import Groups, Thresholds
from xrgs.training.components.base import Component

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import DensifyConf
    from xrgs.splat.settings import DensifySettings


class Densify(Component):
    """Resolution-aware densification and pruning (paper 5.4): two sets of thresholds.

    HR views have those of `splat.densify`, LR views `lr_grow` and `lr_prune` times them. The paper
    doesn't say which set holds at a refinement, whose statistics are of views of both kinds:

    `per_class`: HR and LR views have statistics of their own, and a Gaussian grows where either is
    above its own threshold. The LR prune threshold is for Gaussians that no HR view draws: those
    that had an image-plane gradient in none since the last refinement.

    `current_view`: one statistic of all views; the view of the step at which Gaussians are refined
    sets both thresholds, for all of them.

    The opacity reset follows the larger prune threshold, or the refinement after it would remove
    every Gaussian that the other threshold is for.
    """

    def __init__(self, conf: DensifyConf) -> None:
        if conf.decide not in {"per_class", "current_view"}:
            raise XrgsError(
                f"components.densify.decide={conf.decide}: must be nobody, per_class or"
                " current_view"
            )
        self.conf = conf

    def groups(self, settings: DensifySettings) -> Groups:
        """HR first: what an HR view draws is pruned by the HR threshold."""
        hr = Thresholds(settings.grow_grad2d, settings.prune_opacity)
        lr = Thresholds(hr.grow_grad2d * self.conf.lr_grow, hr.prune_opacity * self.conf.lr_prune)
        return Groups({"HR": hr, "LR": lr}, pooled=self.conf.decide == "current_view")
