"""Resolution-aware densification and pruning [xrgs, section 5.4]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from xrgs.errors import XrgsError
from xrgs.splat.strategy.refinement import DECIDE, Groups, Thresholds
from xrgs.training.components.base import Component, TrainingSetup, check_not_negative

if TYPE_CHECKING:
    from xrgs.config import DensifyConf
    from xrgs.splat.settings import DensifySettings


class Densify(Component):
    """Gives LR views their own thresholds of densification and pruning.

    Section 5.4 of the paper maintains two sets of thresholds for the adaptive density control of
    3D Gaussian Splatting [kerbl2023, section 5.2], as gsplat's `DefaultStrategy` [ye2025] has it:

        threshold_HR < threshold_LR

    HR views have the thresholds of `splat.densify`: `grow_grad2d` 2e-4 in normalised device units,
    `prune_opacity` 0.005. LR views have `lr_grow` and `lr_prune` times those.

    Our choice where the paper is silent: it gives no values; both factors are 2 in
    `conf/ablation/densify.yaml`. Nor does it say which thresholds apply at a refinement, where the
    statistics are averages over 100 steps on views of both kinds. `decide` chooses:

    - `current_view`, in the ablations `densify` and `xrgs`: all views share one statistic, and the
      view of the step at which Gaussians are refined sets both thresholds, for all Gaussians. This
      is the literal reading of sections 5.1 and 5.4.
    - `per_class`: HR and LR views have separate statistics, and a Gaussian grows if either is above
      its own threshold. With equal thresholds this is not the identity: one of two means over fewer
      views is above a threshold more often than the mean over all views. The LR prune threshold
      applies to Gaussians to which no HR view has contributed an image-plane gradient since the
      last refinement.
    - `own_threshold`: each view's gradient is divided by the view's own threshold, and a Gaussian
      grows if the mean over all views is above 1. Nothing depends on the view of the refinement.
      Pruning is as with `per_class`.

    The opacity reset follows the larger prune threshold. Otherwise the refinement after a reset
    would prune every Gaussian to which the larger threshold applies.
    """

    def __init__(self, settings: DensifyConf) -> None:
        """Take the factors and the rule from the settings; XrgsError if `decide` is unknown."""
        if settings.decide not in DECIDE:
            raise XrgsError(
                f"components.densify.decide={settings.decide}: must be one of shared,"
                f" {', '.join(DECIDE)}"
            )
        self.settings = settings

    @classmethod
    def from_settings(cls, settings: DensifyConf, setup: TrainingSetup) -> Self | None:
        """Build the component; `decide: shared` leaves it off."""
        del setup
        check_not_negative("components.densify.lr_grow", settings.lr_grow)
        check_not_negative("components.densify.lr_prune", settings.lr_prune)
        if settings.decide == "own_threshold" and settings.lr_grow == 0:
            raise XrgsError("components.densify.lr_grow=0.0: must be above 0 with own_threshold")
        return None if settings.decide == "shared" else cls(settings)

    def densification_groups(self, settings: DensifySettings) -> Groups:
        """Return the thresholds of HR and LR views; HR comes first, and so takes precedence."""
        hr = Thresholds(settings.grow_grad2d, settings.prune_opacity)
        lr = Thresholds(
            hr.grow_grad2d * self.settings.lr_grow, hr.prune_opacity * self.settings.lr_prune
        )
        return Groups({"HR": hr, "LR": lr}, self.settings.decide)
