"""The ways to degrade HR views into LR views, by `variant.degradation`.

A new way is one module of this folder, named after the value of the key, and one line in
`DEGRADATIONS`. The key of a variant has the code and the settings of the degradation that it uses,
and not those of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.mixture.degradations.box import box
from xrgs.mixture.degradations.digital_zoom import digital_zoom
from xrgs.mixture.degradations.downsample import downsample
from xrgs.mixture.degradations.jpeg import jpeg
from xrgs.mixture.degradations.lanczos import lanczos
from xrgs.mixture.degradations.phone import phone

if TYPE_CHECKING:
    import numpy as np

    from xrgs.config import VariantConf
    from xrgs.photos.images import ImageArray


@dataclass(frozen=True)
class Degradation:
    """One way to make an LR view from an HR view."""

    function: Callable[[ImageArray, VariantConf, np.random.Generator], ImageArray]
    """Takes an HR view [H, W, 3] in 0..1, its sides multiples of `variant.factor`, and a source of
    random numbers that depends on the view. Returns the LR view, which need not be clamped."""
    smaller: bool = False
    """Whether LR views have `variant.factor` times fewer px a side; else they keep their size."""
    keys: tuple[str, ...] = ()
    """The keys of `variant` that no other degradation reads."""


DEGRADATIONS: dict[str, Degradation] = {
    "downsample": Degradation(downsample, smaller=True),
    "box": Degradation(box, smaller=True),
    "lanczos": Degradation(lanczos, smaller=True),
    "phone": Degradation(phone, smaller=True, keys=("phone",)),
    "digital_zoom": Degradation(digital_zoom),
    "jpeg": Degradation(jpeg, keys=("jpeg_quality",)),
}


def resolve_degradation(conf: VariantConf) -> str:
    """Return a key of `DEGRADATIONS`, or `none`; `auto` depends on how views are tagged.

    Tags by a property of the photographs need no degradation, because the views differ already.
    Tags drawn at random mean nothing without one.
    """
    if conf.degradation == "auto":
        return "downsample" if conf.tags == "flag" else "none"
    return conf.degradation
