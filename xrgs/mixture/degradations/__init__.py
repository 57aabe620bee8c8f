"""The degradations that make LR views from HR views, by `variant.degradation`.

To add one, add a module to this folder, named after the value of the config's key, and a line to
`DEGRADATIONS`. A variant's key includes code and settings only of its own degradation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xrgs.config import VariantConf
from xrgs.mixture.degradations.box import box
from xrgs.mixture.degradations.digital_zoom import digital_zoom
from xrgs.mixture.degradations.downsample import downsample
from xrgs.mixture.degradations.jpeg import jpeg
from xrgs.mixture.degradations.lanczos import lanczos
from xrgs.mixture.degradations.phone import phone
from xrgs.photos.images import ImageArray


@dataclass(frozen=True)
class Degradation:
    """A way to make an LR view from an HR view."""

    function: Callable[[ImageArray, VariantConf, np.random.Generator], ImageArray]
    """Function of an HR view [H, W, 3] in 0..1, with sides that are multiples of `variant.factor`,
    the variant's config, and a random generator that depends on the view. It returns the LR view,
    which may exceed 0..1."""
    smaller: bool = False
    """Whether LR views are `variant.factor` times smaller; otherwise they keep their size."""
    keys: tuple[str, ...] = ()
    """Keys of `variant` that only this degradation reads."""


DEGRADATIONS: dict[str, Degradation] = {
    "downsample": Degradation(downsample, smaller=True),
    "box": Degradation(box, smaller=True),
    "lanczos": Degradation(lanczos, smaller=True),
    "phone": Degradation(phone, smaller=True, keys=("phone",)),
    "digital_zoom": Degradation(digital_zoom),
    "jpeg": Degradation(jpeg, keys=("jpeg_quality",)),
}


def resolve_degradation(conf: VariantConf) -> str:
    """Return a key of `DEGRADATIONS`, or `none`; resolve `auto` by `variant.tags`.

    With tags by a property of the photographs, views differ already, and `auto` is `none`. Random
    tags have no meaning without a degradation.
    """
    if conf.degradation == "auto":
        return "downsample" if conf.tags == "flag" else "none"
    return conf.degradation
