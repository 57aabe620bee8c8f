"""The consistency loss of XR-GS, section 5.6, without the weight of its view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from xrgs.training.components import check_not_negative
from xrgs.training.components.consistency import Consistency

if TYPE_CHECKING:
    from xrgs.training.components import TrainingSetup


@dataclass
class Settings:
    """The keys under `components.plugins.unweighted_consistency` of the config."""

    weight: float = 0.0
    """The w of section 5.6; 0 is off. The other keys are those of `components.consistency`."""


class UnweightedConsistency(Consistency):
    """The component `consistency` of xrgs, whose term no weight of the view multiplies.

    The paper's formula of the term has no weight of the view. xrgs adds the term before
    `loss_weighting` multiplies the loss. This component adds it afterwards, since components of
    other packages follow xrgs's own.
    """

    settings_type = Settings

    @classmethod
    def from_settings(  # type: ignore[override]  # settings of its own
        cls, settings: Settings, setup: TrainingSetup
    ) -> Self | None:
        """Build the component; XrgsError if a setting is out of its range."""
        check_not_negative("components.plugins.unweighted_consistency.weight", settings.weight)
        if settings.weight == 0:
            return None
        conf = replace(setup.components.consistency, weight=settings.weight)
        return super().from_settings(conf, setup)
