"""Decides which views are test, HR and LR views, and their sizes, without reading images."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from difflib import get_close_matches
from operator import attrgetter

import numpy as np

from xrgs.config import VariantConf
from xrgs.errors import XrgsError
from xrgs.mixture.degradations import DEGRADATIONS
from xrgs.mixture.sampling_rate import Measures, not_placed, relative_to_largest
from xrgs.mixture.tags import POLICIES
from xrgs.splat.settings import SSIM_WINDOW

#: Largest `variant.phone.blur`, LR px: more than the blur of a lens or a moving hand. Our choice.
_MOST_BLUR = 10


class TooSmallError(XrgsError):
    """A photograph is too small for an LR view."""

    def __init__(self, why: str, advice: str) -> None:
        super().__init__(f"{why}; {advice}")
        self.why, self.advice = why, advice


@dataclass(frozen=True)
class Split:
    """Indices of views, sorted by name, in three disjoint sets that cover all views."""

    test: tuple[int, ...]
    """Held-out views: never trained on, never degraded."""
    hr: tuple[int, ...]
    """Training views tagged HR."""
    lr: tuple[int, ...]
    """Training views tagged LR, which the variant's degradation, if any, is applied to."""


@dataclass(frozen=True)
class HrGeometry:
    """The geometry of an HR view: the photograph is resized, then cropped around its centre."""

    resized: tuple[int, int]
    """Width and height before the crop, px."""
    width: int
    """Width of the HR view, px."""
    height: int
    """Height of the HR view, px."""

    @property
    def crop_offset(self) -> tuple[int, int]:
        """Left and top of the crop in the resized photograph, px."""
        return (self.resized[0] - self.width) // 2, (self.resized[1] - self.height) // 2


def check_variant_conf(conf: VariantConf) -> None:
    """Check a variant's config; XrgsError names a key that is out of its range, and the range."""
    rules = {
        "factor": (conf.factor >= 1, "1 or more"),
        "hr_fraction": (0 <= conf.hr_fraction <= 1, "0 to 1"),
        "min_hr": (conf.min_hr >= 0, "0 or more"),
        "long_side": (conf.long_side >= 0, "0 (the photographs' size) or more"),
        "test_every": (
            conf.test_every == 0 or conf.test_every >= 2,
            "0 (none held out), or 2 or more",
        ),
        "selection": _one_of(conf.selection, "random", "uniform"),
        "tags": _one_of(conf.tags, "flag", *POLICIES),
        "hr_above": (0 <= conf.hr_above <= 1, "0 (use variant.hr_fraction) to 1"),
        "degradation": _one_of(conf.degradation, "auto", "none", *DEGRADATIONS),
        "jpeg_quality": (1 <= conf.jpeg_quality <= 95, "1 to 95"),
        "phone.blur": (0 <= conf.phone.blur <= _MOST_BLUR, f"0 to {_MOST_BLUR}"),
        "phone.noise": (0 <= conf.phone.noise <= 255, "0 to 255"),
        "phone.jpeg_quality": (1 <= conf.phone.jpeg_quality <= 95, "1 to 95"),
        "sfm.lr_images": _one_of(conf.sfm.lr_images, "upsampled", "native"),
        "sfm.long_side": (conf.sfm.long_side >= 0, "0 (the photographs' size) or more"),
        "sfm.min_registered": (0 <= conf.sfm.min_registered <= 1, "0 to 1"),
        "sfm.max_num_features": (conf.sfm.max_num_features >= 0, "0 (automatic) or more"),
        "sfm.camera": _one_of(conf.sfm.camera, "auto", "single", "per_image"),
        "sfm.first_octave": (conf.sfm.first_octave in (None, -1, 0), "null (by size), -1 or 0"),
        "sfm.min_inliers": (conf.sfm.min_inliers >= 6, "6 or more"),
    }
    for key, (valid, accepted) in rules.items():
        if not valid:
            raise XrgsError(f"variant.{key}={attrgetter(key)(conf)}: must be {accepted}")
    if conf.tags == "flag" and conf.hr_above:
        raise XrgsError(
            f"variant.hr_above={conf.hr_above}: not read with variant.tags=flag, whose share of HR "
            "views is variant.hr_fraction"
        )


def _one_of(value: str, *choices: str) -> tuple[bool, str]:
    return value in choices, " or ".join(choices)


def check_test_names(names: Sequence[str], conf: VariantConf) -> None:
    """Refuse names in `variant.test` that the scene does not have, and suggest a similar name."""
    missing = [name for name in conf.test if name not in names]
    if not missing:
        return
    meant = _meant(conf.test, names)
    similar = next((name for name in meant if name not in conf.test), None)
    hint = f"did you mean {similar}?{_words(meant)}" if similar else "it has none"
    raise XrgsError(
        f"variant.test: the scene has no view {missing[0]}; {hint} The name of a view is its file's"
        " name without the suffix"
    )


def _meant(given: Sequence[str], names: Sequence[str]) -> list[str]:
    """Replace each name that the scene does not have by the most similar name.

    A name with commas may have been parsed as several names, and quotes in a name as quotes of
    YAML.
    """
    meant, rest = [], list(given)
    while rest:
        wholes = [
            (joined, count)
            for count in range(len(rest), 0, -1)
            for joined in (", ".join(rest[:count]), ",".join(rest[:count]))
        ]
        similar = get_close_matches(rest[0], names, n=1, cutoff=0.0)
        single = [(name, 1) for name in (f"'{rest[0]}'", f'"{rest[0]}"', *similar)]
        known = (guess for guess in (*wholes, *single) if guess[0] in names)
        name, count = next(known, (rest[0], 1))
        meant.append(name)
        rest = rest[count:]
    return meant


def _words(names: Sequence[str]) -> str:
    """Return a hint on quoting for names that need quotes on a command line and in YAML."""
    values = {"true", "false", "null", "yes", "no", "on", "off"}
    plain = (re.fullmatch(r"[A-Za-z][\w.-]*", n) and n.casefold() not in values for n in names)
    if all(plain):
        return ""
    escaped = (name.replace("\\", r"\\").replace('"', r"\"") for name in names)
    test = ",".join(f'"{name}"' for name in escaped)
    word = shlex.quote(f"variant.test=[{test}]")
    return f" On a command line it is {word}, in a file of YAML test: [{test}]."


def split_views(
    names: Sequence[str], conf: VariantConf, scores: Sequence[float] | None = None
) -> Split:
    """Hold out the views `test`, else every n-th view, and divide the other views into HR and LR.

    Args:
        names: The names of the views, sorted.
        conf: The variant's config. HR views are `hr_fraction` of the training views, at least
            `min_hr`, or all views with a score of `hr_above` or more.
        scores: A score for each view in 0..1, higher for HR; NaN means LR. Views with equal scores
            get the same tag, so that there may be more HR views than `hr_fraction`. None selects
            the HR views by `variant.selection`.

    Raises:
        XrgsError: The scores give all training views the same tag, but the config asks for both.
    """
    every, views = conf.test_every, range(len(names))
    if conf.test:
        test = tuple(i for i in views if names[i] in conf.test)
    else:
        test = tuple(views[::every]) if every else ()
    train = [i for i in views if i not in test]
    chosen = _select(train, conf) if scores is None else _select_by_score(train, scores, conf)
    hr = tuple(i for i in train if i in chosen)
    return Split(test, hr, tuple(i for i in train if i not in chosen))


def split_before_sfm(
    names: Sequence[str], sizes: Sequence[tuple[int, int]], conf: VariantConf
) -> Split:
    """Split the views, of photographs of these sizes, px, before SfM; raises as `split_views` does.

    If tags depend on depth, all training views are HR until SfM is done.
    """
    if conf.tags not in POLICIES:
        return split_views(names, conf)
    if POLICIES[conf.tags].needs_depth:
        return split_views(names, replace(conf, hr_fraction=1.0))
    return split_by_score(names, [not_placed(size) for size in sizes], conf)


def split_by_score(names: Sequence[str], measures: Sequence[Measures], conf: VariantConf) -> Split:
    """Split the views by the scores of the policy `variant.tags`, see `split_views`."""
    scores = [POLICIES[conf.tags].score(measured) for measured in measures]
    return split_views(names, conf, relative_to_largest(scores))


def shortage(split: Split, registered: Set[int], conf: VariantConf) -> str:
    """Return a text if too few views are registered for training and test, else an empty text.

    If the config holds out no views, the training views are the test views.
    """
    hr, lr, tests = (registered & set(part) for part in (split.hr, split.lr, split.test))
    if not (conf.test or split.test):
        tests = set(registered)
    class_lost = (split.hr and not hr) or (split.lr and not lr)
    if not class_lost and len(hr) + len(lr) >= 2 and tests:
        return ""
    return (
        f"{len(hr)} HR, {len(lr)} LR and {len(tests)} test views; at least one of each class and"
        " two training views are needed"
    )


def split_notes(split: Split, conf: VariantConf) -> list[str]:
    """Return a note if no view is LR although the config asks for LR views."""
    views = len(split.hr)
    if split.lr or conf.tags != "flag" or conf.hr_fraction == 1:
        return []
    least = conf.min_hr >= views
    why = f"variant.min_hr={conf.min_hr}" if least else f"variant.hr_fraction={conf.hr_fraction}"
    return [f"no LR view: {views} training photographs are all HR by {why}; nothing is mixed"]


def _hr_count(views: int, conf: VariantConf) -> int:
    return min(views, max(conf.min_hr, round(conf.hr_fraction * views)))


def _select(train: Sequence[int], conf: VariantConf) -> set[int]:
    """Select the HR views, at random or evenly spaced, by `variant.selection`."""
    count = _hr_count(len(train), conf)
    if conf.selection == "uniform":
        return {train[(2 * k + 1) * len(train) // (2 * count)] for k in range(count)}
    rng = np.random.default_rng(conf.seed)
    return set(rng.choice(train, count, replace=False).tolist()) if count else set()


def _select_by_score(train: Sequence[int], scores: Sequence[float], conf: VariantConf) -> set[int]:
    """Select the views with the highest scores as HR, or those with `hr_above` or more."""
    known = sorted((scores[i] for i in train if not np.isnan(scores[i])), reverse=True)
    count = _hr_count(len(known), conf)
    threshold = conf.hr_above or (known[count - 1] if count else np.inf)
    chosen = {i for i in train if scores[i] >= threshold}
    two_classes = conf.hr_above > 0 or 0 < conf.hr_fraction < 1
    if known and two_classes and len(chosen) in (0, len(known)):
        limit = f"hr_above={conf.hr_above}" if conf.hr_above else f"hr_fraction={conf.hr_fraction}"
        raise XrgsError(
            f"variant.tags={conf.tags}: every training view is {'HR' if chosen else 'LR'} at "
            f"variant.{limit}; their values are {known[-1]:.3f} to {known[0]:.3f} of the best"
        )
    return chosen


def shrink_factor(sizes: Sequence[tuple[int, int]], long_side: int) -> float:
    """Return the common factor in (0, 1] for resizing all photographs, of these sizes in px.

    With it the longest side of all photographs becomes `long_side`, px. It is 1 if `long_side` is 0
    or larger than all sides.
    """
    largest = max(max(size) for size in sizes)
    return min(long_side or largest, largest) / largest


def hr_geometry(size: tuple[int, int], shrink: float, conf: VariantConf) -> HrGeometry:
    """Compute the size of the HR view of a photograph, px, a multiple of `variant.factor`.

    `shrink` is the result of `shrink_factor` for the scene.

    Raises:
        TooSmallError: The LR view, `factor` times smaller, would be smaller than the SSIM window of
            the training loss; the message names a key to change.
    """
    resized = round(size[0] * shrink), round(size[1] * shrink)
    # The crop makes the factor of x and y exactly equal; without it they differ by up to 0.6%.
    lr = resized[0] // conf.factor, resized[1] // conf.factor
    if min(lr) < SSIM_WINDOW:
        helps = []
        if min(resized) >= SSIM_WINDOW:
            helps.append(f"lower variant.factor to {min(resized) // SSIM_WINDOW}")
        if shrink < 1 and min(size) // conf.factor >= SSIM_WINDOW:
            helps.append(f"raise variant.long_side={conf.long_side}")
        views = "views" if conf.factor == 1 else f"variant.factor={conf.factor}: LR views"
        raise TooSmallError(
            f"{views} of {lr[0]}x{lr[1]} px are smaller than the SSIM window of {SSIM_WINDOW} px",
            " or ".join(helps) or "the photograph is too small",
        )
    return HrGeometry(resized, lr[0] * conf.factor, lr[1] * conf.factor)
