"""The ways to degrade HR views into LR views, by `variant.degradation`.

A new way is one module of this folder, named after the value of the key, and one line in
`DEGRADATIONS`. The key of a variant has the code of the degradation that it uses, and not the code
of the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.capture.degradations.digital_zoom import digital_zoom
from xrgs.capture.degradations.downsample import downsample
from xrgs.capture.degradations.jpeg import jpeg

if TYPE_CHECKING:
    from collections.abc import Callable

    from xrgs.capture.images import ImageArray
    from xrgs.config import VariantConf

#: Each takes an HR view [H, W, 3] in 0..1, its sides multiples of `variant.factor`, and returns the
#: LR view, which need not be clamped.
DEGRADATIONS: dict[str, Callable[[ImageArray, VariantConf], ImageArray]] = {
    "downsample": downsample,
    "digital_zoom": digital_zoom,
    "jpeg": jpeg,
}


def resolve_degradation(conf: VariantConf) -> str:
    """Return a key of `DEGRADATIONS`, or `none`; `auto` depends on how views are tagged.

    Tags by a property of the photographs need no degradation, because the views differ already.
    Tags drawn at random mean nothing without one.
    """
    if conf.degradation == "auto":
        return "downsample" if conf.tags == "flag" else "none"
    return conf.degradation
