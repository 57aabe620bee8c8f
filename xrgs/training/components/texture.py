"""The amount of detail in a photograph, pixel by pixel [xrgs, section 7.2]."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad

from xrgs.splat.rounding import rounded_mean, rounded_sqrt


def gradient_magnitude(image: Tensor) -> Tensor:
    """Compute the magnitude of the image gradient at each pixel.

    With forward differences d_x and d_y of each of the three channels,

        g = sqrt(mean over channels of (d_x^2 + d_y^2)).

    The unit of length is a pixel, so g measures detail near the limit of the image's resolution. In
    an LR view, a large g indicates that detail is missing.

    Our choice where the paper is silent: section 7.2 says only "via Fourier or gradient magnitude".

    Args:
        image: [H, W, 3] in 0..1, at least 2 x 2 px.

    Returns:
        [H, W] intensity per px, at most sqrt(2); the last row and column are copies of their
        neighbours.
    """
    inner = image[:-1, :-1]
    squared = (image[:-1, 1:] - inner).square() + (image[1:, :-1] - inner).square()
    red, green, blue = squared.unbind(-1)
    magnitude = rounded_sqrt((red + green + blue) / 3)  # [H - 1, W - 1]
    return pad(magnitude[None], (0, 1, 0, 1), mode="replicate")[0]


def mean_gradient(image: Tensor, mask: Tensor | None) -> float:
    """Average `gradient_magnitude` over an image, or over the used pixels of its mask.

    A used pixel counts only if its right and lower neighbours are used too, since the differences
    read them.

    Args:
        image: [H, W, 3] in 0..1, at least 2 x 2 px.
        mask: [H, W] bool, True for a used pixel; None uses all.

    Returns:
        Intensity per px; 0 if no pixel counts.
    """
    magnitude = gradient_magnitude(image)
    if mask is None:
        return rounded_mean(magnitude)
    known = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1]
    return rounded_mean(magnitude[:-1, :-1][known]) if known.any() else 0.0
