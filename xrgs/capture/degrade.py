"""How an LR view is made of an HR one; float32 [H, W, 3] in 0..1, not clamped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.capture import images

if TYPE_CHECKING:
    from xrgs.capture.images import Photo
    from xrgs.config import VariantConf


def kind(conf: VariantConf) -> str:
    """`downsample`, `digital_zoom`, `jpeg` or `none`; `auto` resolved.

    Tags that follow what the photographs are by nature need no degradation; those drawn at random
    mean nothing without one.
    """
    if conf.degradation == "auto":
        return "downsample" if conf.tags == "flag" else "none"
    return conf.degradation


def degrade(high: Photo, conf: VariantConf) -> Photo:
    """The LR view: `factor` times smaller (paper 4.1), or of the same size with less in it."""
    height, width = high.shape[:2]
    how = kind(conf)
    if how == "none":
        return high
    if how == "jpeg":
        return images.through_jpeg(high, conf.jpeg_quality)
    small = images.resize(high, width // conf.factor, height // conf.factor)
    return small if how == "downsample" else images.resize(small, width, height)
