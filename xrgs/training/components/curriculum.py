"""LR-only warm-up [xrgs, section 5.5]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from xrgs.errors import XrgsError
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import CurriculumConf


class Curriculum(Component):
    """Trains only on LR views before step `lr_only`: the LR-only warm-up.

    Section 5.5 of the paper, with N typically 5000:

        D_train(t < N) = {LR views only}

    N is `lr_only`, in steps of a 30,000-step run.

    Our choice where the paper is silent: densification, pruning and opacity resets run during the
    warm-up, on the statistics of LR views. The epoch of LR views in progress at the end of the
    warm-up is completed first.
    """

    def __init__(self, settings: CurriculumConf, views: Sequence[TrainingView]) -> None:
        """Set the length of the warm-up; XrgsError if none of the training views is tagged LR."""
        if not any(view.tag == "LR" for view in views):
            raise XrgsError(
                f"components.curriculum.lr_only={settings.lr_only}: there is no LR view to warm up"
                " on; set it to 0, or train on the mixed views (train.views=mixed)"
            )
        self.lr_only = settings.lr_only

    @classmethod
    def from_settings(cls, settings: CurriculumConf, setup: TrainingSetup) -> Self:
        """Build the component."""
        return cls(settings, setup.data.train)

    def allows_view(self, step: Step) -> bool:
        """Allow LR views always, and HR views after the warm-up."""
        return step.view.tag == "LR" or step.nominal >= self.lr_only
