"""Which views are held out, which stay HR, and what size they have: arithmetic on numbers alone."""

from __future__ import annotations

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
    """Held out: never trained on, never downsampled."""
    hr: tuple[int, ...]
    """Trained on at full size."""
    lr: tuple[int, ...]
    """Trained on `factor` times smaller."""


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
        "selection": (conf.selection in ("random", "uniform"), "random or uniform"),
        "sfm.lr_images": (conf.sfm.lr_images in ("upsampled", "native"), "upsampled or native"),
        "sfm.min_registered": (0 <= conf.sfm.min_registered <= 1, "0 to 1"),
        "sfm.max_num_features": (conf.sfm.max_num_features >= 0, "0 (automatic) or more"),
    }
    for key, (good, wanted) in rules.items():
        if not good:
            value = conf.sfm if key.startswith("sfm.") else conf
            given = getattr(value, key.removeprefix("sfm."))
            raise XrgsError(f"variant.{key}={given}: must be {wanted}")


def split(views: int, conf: VariantConf) -> Split:
    """Every `test_every`-th view held out; of the others a share stays HR, at least `min_hr`."""
    every = conf.test_every
    test = tuple(range(0, views, every)) if every else ()
    train = [i for i in range(views) if i not in test]
    count = min(len(train), max(conf.min_hr, round(conf.hr_fraction * len(train))))
    if conf.selection == "uniform":
        chosen = {train[(2 * k + 1) * len(train) // (2 * count)] for k in range(count)}
    else:
        rng = np.random.default_rng(conf.seed)
        chosen = set(rng.choice(train, count, replace=False).tolist()) if count else set()
    lr = tuple(i for i in train if i not in chosen)
    return Split(test, tuple(sorted(chosen)), lr)


def frame(width: int, height: int, conf: VariantConf) -> Frame:
    """The HR size of photographs of `width` x `height`: a multiple of the factor, never enlarged.

    Raises:
        XrgsError: the LR views would be smaller than the SSIM window.
    """
    side = min(conf.long_side or max(width, height), max(width, height))
    scale = side / max(width, height)
    resized = round(width * scale), round(height * scale)
    # Cropped so that x and y shrink by the same, whole, factor (else they differ by up to 0.6%).
    lr = resized[0] // conf.factor, resized[1] // conf.factor
    if min(lr) < SSIM_WINDOW:
        raise XrgsError(
            f"variant.factor={conf.factor}: LR views of {lr[0]}x{lr[1]} px are smaller than the "
            f"SSIM window of {SSIM_WINDOW}; lower it, or raise variant.long_side={conf.long_side}"
        )
    return Frame(resized, lr[0] * conf.factor, lr[1] * conf.factor)
