"""Makes LR views as a phone makes photographs: blurred, averaged by pixels, noisy, compressed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xrgs.photos import images

if TYPE_CHECKING:
    from xrgs.config import VariantConf
    from xrgs.photos.images import ImageArray


def phone(high: ImageArray, conf: VariantConf, rng: np.random.Generator) -> ImageArray:
    """Return the LR view [H / factor, W / factor, 3].

    Its steps, all on sRGB values:

    1. a Gaussian blur of `phone.blur` LR px, for lens, focus and motion;
    2. the mean over the area of an LR pixel;
    3. noise of a normal distribution, `phone.noise` steps of 8 bits, in each channel on its own;
    4. JPEG with halved chroma (4:2:0) at `phone.jpeg_quality`.

    Our choice: a test that the kernel which training knows is not the one that made the views. A
    raw converter sharpens and removes noise too; both are left out.
    """
    from scipy import ndimage  # not at the top: plans import this module, and blur nothing

    phone = conf.phone
    sigma = phone.blur * conf.factor  # HR px
    blurred = ndimage.gaussian_filter(high.astype(np.float64), (sigma, sigma, 0))
    low = images.block_means(blurred, conf.factor)
    noise = rng.normal(0, phone.noise / 255, low.shape)
    return images.through_jpeg((low + noise).astype(np.float32), phone.jpeg_quality)
