"""Checks the values of a cell's config when it is planned, before anything is built or trained."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.capture.degradations import resolve_degradation
from xrgs.capture.split import check_variant_conf
from xrgs.errors import XrgsError
from xrgs.evaluation.metrics import SSIM_WINDOW

if TYPE_CHECKING:
    from xrgs.config import Conf

#: The shortest side of an image that SSIM, of the loss and of scores, can be computed of, px.
_MIN_SIDE = SSIM_WINDOW // 2 + 1


def check(conf: Conf) -> None:
    """Refuse a config with which every cell of a sweep would fail.

    `xrgs.composing.to_conf` has checked what needs no knowledge of photographs.

    Args:
        conf: A cell's config.

    Raises:
        XrgsError: A value is out of its range; the message names the key.
    """
    check_variant_conf(conf.variant)
    side, smaller = conf.variant.long_side, 1
    if resolve_degradation(conf.variant) == "downsample":
        smaller = conf.variant.factor
    if 0 < side < smaller * _MIN_SIDE:
        raise XrgsError(
            f"variant.long_side={side}: must be 0 (the photographs' size) or at least"
            f" {smaller * _MIN_SIDE}, so that LR views have {_MIN_SIDE} px a side"
        )
