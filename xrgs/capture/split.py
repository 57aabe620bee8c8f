"""Which views are held out, which stay HR, and what size they have: arithmetic on numbers alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from xrgs.config import VariantConf

#: An LR view must hold at least one window of the training loss's SSIM.
SSIM_WINDOW = 11


@dataclass(frozen=True)
class Split:
    """Indices of the name-sorted views, ascending; the three are disjoint and cover all."""

    test: tuple[int, ...]
    """Held out: never trained on, never degraded."""
    hr: tuple[int, ...]
    """Trained on as they are."""
    lr: tuple[int, ...]
    """Trained on, and degraded where the variant degrades."""


@dataclass(frozen=True)
class Frame:
    """How a photograph becomes an HR view: shrunk, then cropped about its centre."""

    resized: tuple[int, int]
    """Width and height before the crop, px."""
    width: int
    height: int

    @property
    def corner(self) -> tuple[int, int]:
        """Left and top of the crop, px."""
        return (self.resized[0] - self.width) // 2, (self.resized[1] - self.height) // 2


def check(conf: VariantConf) -> None:
    """Refuse a variant that can't be made.

    Raises:
        XrgsError: names the key, its value and what it may be.
    """
    rules = {
        "factor": (conf.factor >= 1, "1 or more"),
        "hr_fraction": (0 <= conf.hr_fraction <= 1, "0 to 1"),
        "min_hr": (conf.min_hr >= 0, "0 or more"),
        "long_side": (conf.long_side >= 0, "0 (the photographs' size) or more"),
        "test_every": (conf.test_every == 0 or conf.test_every >= 2, "0 (none held out), or 2+"),
        "selection": _one_of(conf.selection, "random", "uniform"),
        "tags": _one_of(conf.tags, "flag", "megapixels", "distance", "sampling_rate"),
        "hr_above": (0 <= conf.hr_above <= 1, "0 (by variant.hr_fraction) to 1"),
        "degradation": _one_of(
            conf.degradation, "auto", "none", "downsample", "digital_zoom", "jpeg"
        ),
        "jpeg_quality": (1 <= conf.jpeg_quality <= 95, "1 to 95"),
        "sfm.lr_images": _one_of(conf.sfm.lr_images, "upsampled", "native"),
        "sfm.min_registered": (0 <= conf.sfm.min_registered <= 1, "0 to 1"),
        "sfm.max_num_features": (conf.sfm.max_num_features >= 0, "0 (automatic) or more"),
        "sfm.camera": _one_of(conf.sfm.camera, "auto", "single", "per_image"),
        "sfm.first_octave": (conf.sfm.first_octave in (None, -1, 0), "null (by size), -1 or 0"),
        "sfm.min_inliers": (conf.sfm.min_inliers >= 6, "6 or more"),
    }
    for key, (good, wanted) in rules.items():
        if not good:
            value = conf.sfm if key.startswith("sfm.") else conf
            given = getattr(value, key.removeprefix("sfm."))
            raise XrgsError(f"variant.{key}={given}: must be {wanted}")
    if conf.tags == "flag" and conf.hr_above:
        raise XrgsError(f"variant.hr_above={conf.hr_above}: not read with variant.tags=flag")


def _one_of(value: str, *choices: str) -> tuple[bool, str]:
    return value in choices, " or ".join(choices)


def split(views: int, conf: VariantConf, scores: Sequence[float] | None = None) -> Split:
    """Every `test_every`-th view held out; of the others some are HR.

    Args:
        views: How many there are.
        conf: Which are HR: a share, at least `min_hr`; or what scores `hr_above` and more.
        scores: A view's value, 0..1, high for HR; NaN where it is not known, which makes it LR.
            Equals are of one class, so that a share may be exceeded. None draws by `selection`.

    Raises:
        XrgsError: the scores put all into one class though both were asked for.
    """
    every = conf.test_every
    test = tuple(range(0, views, every)) if every else ()
    train = [i for i in range(views) if i not in test]
    chosen = _drawn(train, conf) if scores is None else _best(train, scores, conf)
    hr = tuple(i for i in train if i in chosen)
    return Split(test, hr, tuple(i for i in train if i not in chosen))


def _share(views: int, conf: VariantConf) -> int:
    return min(views, max(conf.min_hr, round(conf.hr_fraction * views)))


def _drawn(train: Sequence[int], conf: VariantConf) -> set[int]:
    count = _share(len(train), conf)
    if conf.selection == "uniform":
        return {train[(2 * k + 1) * len(train) // (2 * count)] for k in range(count)}
    rng = np.random.default_rng(conf.seed)
    return set(rng.choice(train, count, replace=False).tolist()) if count else set()


def _best(train: Sequence[int], scores: Sequence[float], conf: VariantConf) -> set[int]:
    known = sorted((scores[i] for i in train if not np.isnan(scores[i])), reverse=True)
    count = _share(len(known), conf)
    least = conf.hr_above or (known[count - 1] if count else np.inf)
    chosen = {i for i in train if scores[i] >= least}
    mixed = conf.hr_above > 0 or 0 < conf.hr_fraction < 1
    if known and mixed and len(chosen) in (0, len(known)):
        limit = f"hr_above={conf.hr_above}" if conf.hr_above else f"hr_fraction={conf.hr_fraction}"
        raise XrgsError(
            f"variant.tags={conf.tags}: every training view is {'HR' if chosen else 'LR'} at "
            f"variant.{limit}; their values are {known[-1]:.3f} to {known[0]:.3f} of the best"
        )
    return chosen


def scale(sizes: Sequence[tuple[int, int]], conf: VariantConf) -> float:
    """By how much every photograph of a scene is shrunk, 0..1; its largest goes to `long_side`."""
    largest = max(max(size) for size in sizes)
    return min(conf.long_side or largest, largest) / largest


def frame(size: tuple[int, int], shrink: float, conf: VariantConf) -> Frame:
    """The HR size of a photograph of `size`: a multiple of the factor.

    Raises:
        XrgsError: its copy `factor` times smaller would be smaller than the SSIM window.
    """
    resized = round(size[0] * shrink), round(size[1] * shrink)
    # Cropped so that x and y shrink by the same, whole, factor (else they differ by up to 0.6%).
    lr = resized[0] // conf.factor, resized[1] // conf.factor
    if min(lr) < SSIM_WINDOW:
        raise XrgsError(
            f"variant.factor={conf.factor}: LR views of {lr[0]}x{lr[1]} px are smaller than the "
            f"SSIM window of {SSIM_WINDOW}; lower it, or raise variant.long_side={conf.long_side}"
        )
    return Frame(resized, lr[0] * conf.factor, lr[1] * conf.factor)
