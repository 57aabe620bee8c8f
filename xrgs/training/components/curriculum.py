"""LR-only warm-up (paper 5.5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.training.components.base import Component, Step, TrainingView

if TYPE_CHECKING:  # xrgs.config loads Hydra, which training does without
    from xrgs.config import CurriculumConf


class Curriculum(Component):
    """LR-only warm-up (paper 5.5): HR views wait until step `lr_only` of 30,000.

    All else goes on meanwhile: the Gaussians that LR views ask for are grown, pruned and reset. A
    round through the LR views that is under way at the end of the warm-up is finished first.
    """

    def __init__(self, conf: CurriculumConf, views: Sequence[TrainingView]) -> None:
        if not any(view.tag == "LR" for view in views):
            raise XrgsError(
                f"components.curriculum.lr_only={conf.lr_only}: there is no LR view to warm up on"
            )
        self.lr_only = conf.lr_only

    def trains_on(self, step: Step) -> bool:
        """LR views always, HR views after the warm-up."""
        return step.view.tag == "LR" or step.nominal >= self.lr_only
