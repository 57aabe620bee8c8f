"""Estimates the blur of LR photographs from power spectra.

Training through a known kernel is wrong if the photographs are blurrier than the kernel.
Photographs of one scene have about the same power at the same frequency in the scene. So the power
that LR photographs lack, compared with HR photographs, shows their blur. No pairs of photographs of
the same view are needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xrgs.mixture.views import View
from xrgs.photos import images, masks

Array = NDArray[np.float64]

#: Edges of the frequency rings in which power is compared, cycles per LR px. Lower frequencies
#: depend on the content of a view; higher ones suffer from aliasing, noise and JPEG. Our choice.
_RINGS = np.linspace(0.1, 0.3, 9)
#: Least side, px at the sampling rate of LR views, at which each ring contains a frequency.
_LEAST_SIDE = 32
#: Largest number of views of each tag that are read. Our choice.
_MOST_VIEWS = 16
#: Least sigma, LR px, at which LR photographs are reported as blurrier than their pixels. The box
#: of a pixel has sqrt(1 / 12) = 0.29, LR views of degradation=phone 0.85. Our choice, in between.
_BLURRY = 0.5
_LUMA = np.array([0.299, 0.587, 0.114])


def lr_blur(views: Sequence[View]) -> float | None:
    """Estimate the blur of LR training views as the sigma of a Gaussian, LR px; 0 or more.

    The power P of LR and HR views, in rings of frequencies f in cycles per LR px, is fitted by

        log P_LR(f) - log P_HR(f) = c - (2 pi sigma f)^2

    where log P is the mean over views. HR views are evaluated at the same frequencies in the scene,
    converted by the median sampling rates of both tags. The box of a pixel has a sigma of 0.29. The
    result is the blur in excess of that of HR views, which is small if these sample the scene much
    more finely. It is None if a tag has no view that is large enough.
    """
    hr, lr = (
        [view for view in views if (view.split, view.tag) == ("train", tag)] for tag in ("HR", "LR")
    )
    if not hr or not lr:
        return None
    finer = float(
        np.median([view.sampling_rate for view in hr])
        / np.median([view.sampling_rate for view in lr])
    )
    sharp, blurred = _mean_log_power(hr, finer), _mean_log_power(lr, 1.0)
    if sharp is None or blurred is None:
        return None
    middle = (_RINGS[1:] + _RINGS[:-1]) / 2
    slope, _ = np.polyfit((2 * np.pi * middle) ** 2, blurred - sharp, 1)
    return float(np.sqrt(max(0.0, -slope)))


def blur_notes(blur: float | None) -> list[str]:
    """Return a note if LR photographs are blurrier than their pixels, with a remedy."""
    if blur is None or blur <= _BLURRY:
        return []
    return [
        f"LR photographs are blurrier than their pixels: by a Gaussian of {blur:.2f} px, where a"
        " pixel's area has 0.29. plus, lean and +ablation=formation learn the blur;"
        " components.supersampled alone takes them to be sharper"
    ]


def _mean_log_power(views: Sequence[View], finer: float) -> Array | None:
    """Average the `_log_power` of views; None if all views are too small."""
    least = _LEAST_SIDE * finer
    usable = [view for view in views if min(view.width, view.height) >= least]
    if not usable:
        return None
    every = math.ceil(len(usable) / _MOST_VIEWS)
    mean: Array = np.mean([_log_power(view, finer) for view in usable[::every]], axis=0)
    return mean


def _log_power(view: View, finer: float) -> Array:
    """Return the logarithm of the mean power of a view's luma in each ring.

    `finer` is its sampling rate over that of LR views.
    """
    size = view.width, view.height
    pixels = np.asarray(images.read_png_pil(view.file, size))
    mask = None if view.mask is None else images.read_mask(view.mask, size)
    luma = masks.filled(pixels, mask) @ _LUMA
    # A window hides the discontinuity at the borders.
    window = np.outer(np.hanning(view.height), np.hanning(view.width))
    luma = (luma - np.average(luma, weights=window)) * window
    power = np.abs(np.fft.fft2(luma)) ** 2
    rows, columns = np.fft.fftfreq(view.height), np.fft.fftfreq(view.width)
    ring = np.digitize(finer * np.hypot(rows[:, None], columns), _RINGS).ravel()
    counts = np.bincount(ring, minlength=len(_RINGS) + 1)[1:-1]
    sums = np.bincount(ring, power.ravel(), minlength=len(_RINGS) + 1)[1:-1]
    # 1 is the power of a single 8-bit step: it keeps the logarithm finite for a uniform view.
    return np.log(sums / counts + 1.0)
