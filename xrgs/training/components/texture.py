"""The amount of detail in a photograph, pixel by pixel [xrgs, section 7.2]."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad

from xrgs.splat.rounding import rounded_sqrt


def gradient_magnitude(image: Tensor) -> Tensor:
    """Compute the magnitude of the image gradient at each pixel.

    With forward differences d_x and d_y of each of the three channels,

        g = sqrt(mean over channels of (d_x^2 + d_y^2)).

    The unit of length is a pixel. So g measures detail near the image's own limit of resolution: in
    an LR view it indicates detail beyond that limit.

    Our choice where the paper is silent: section 7.2 only says "via Fourier or gradient magnitude".

    Args:
        image: [H, W, 3] in 0..1, at least 2 x 2 px.

    Returns:
        [H, W] intensity per px, at most sqrt(2); the last row and column repeat the ones before.
    """
    inner = image[:-1, :-1]
    squared = (image[:-1, 1:] - inner).square() + (image[1:, :-1] - inner).square()
    red, green, blue = squared.unbind(-1)
    magnitude = rounded_sqrt((red + green + blue) / 3)  # [H - 1, W - 1]
    return pad(magnitude[None], (0, 1, 0, 1), mode="replicate")[0]
