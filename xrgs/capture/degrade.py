"""Degrades HR views into LR views: images [H, W, 3], float32 in 0..1, not clamped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.capture import images

if TYPE_CHECKING:
    from xrgs.capture.images import ImageArray
    from xrgs.config import VariantConf


def resolve_degradation(conf: VariantConf) -> str:
    """Resolve `variant.degradation`, where `auto` depends on how views are tagged.

    Tags by a property of the photographs need no degradation, because the views differ already;
    tags drawn at random mean nothing without one.

    Args:
        conf: The variant's config.

    Returns:
        `downsample`, `digital_zoom`, `jpeg` or `none`.
    """
    if conf.degradation == "auto":
        return "downsample" if conf.tags == "flag" else "none"
    return conf.degradation


def degrade(high: ImageArray, conf: VariantConf) -> ImageArray:
    """Degrade an HR view into its LR view.

    Args:
        high: The HR view [H, W, 3], its sides multiples of `variant.factor`.
        conf: The variant's config.

    Returns:
        With `downsample` an image `factor` times smaller per side (paper 4.1). With `digital_zoom`
        the same resized back to [H, W, 3], with `jpeg` the image after JPEG compression, and with
        `none` the image itself: these keep the size.
    """
    height, width = high.shape[:2]
    degradation = resolve_degradation(conf)
    if degradation == "none":
        return high
    if degradation == "jpeg":
        return images.through_jpeg(high, conf.jpeg_quality)
    small = images.resize(high, width // conf.factor, height // conf.factor)
    return small if degradation == "downsample" else images.resize(small, width, height)
