"""Makes LR views similar to photographs of a phone: blur, pixel averages, noise, compression."""

from __future__ import annotations

import numpy as np

from xrgs.config import VariantConf
from xrgs.photos import images
from xrgs.photos.images import ImageArray


def phone(high: ImageArray, conf: VariantConf, rng: np.random.Generator) -> ImageArray:
    """Return the LR view [H / factor, W / factor, 3].

    Steps, all on sRGB values:

    1. a Gaussian blur with a sigma of `phone.blur` LR px, for lens, focus and motion;
    2. the mean over the area of an LR pixel;
    3. normal noise with a sigma of `phone.noise` 8-bit steps, independent in each channel;
    4. JPEG with halved chroma (4:2:0) at `phone.jpeg_quality`.

    Our choice, to test views that were not made by the kernel that training assumes. The sharpening
    and denoising of a raw converter are left out.
    """
    from scipy import ndimage  # plans import this module without calling it

    phone = conf.phone
    sigma = phone.blur * conf.factor  # HR px
    blurred = ndimage.gaussian_filter(high.astype(np.float64), (sigma, sigma, 0))
    low = images.block_means(blurred, conf.factor)
    noise = rng.normal(0, phone.noise / 255, low.shape)
    return images.through_jpeg((low + noise).astype(np.float32), phone.jpeg_quality)
