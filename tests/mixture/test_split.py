from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.config import PhoneConf, VariantConf
from xrgs.errors import XrgsError
from xrgs.mixture.degradations import DEGRADATIONS
from xrgs.mixture.split import (
    check_test_names,
    check_variant_conf,
    hr_geometry,
    shrink_factor,
    split_views,
)
from xrgs.splat.loss import WINDOW

Make = Callable[..., VariantConf]


def names(views: int) -> list[str]:
    return [f"view_{i:03d}" for i in range(views)]


CHANGES = st.fixed_dictionaries(
    {
        "hr_fraction": st.floats(0, 1),
        "min_hr": st.integers(0, 5),
        "selection": st.sampled_from(["random", "uniform"]),
        "test_every": st.sampled_from([0, 2, 3, 8]),
        "seed": st.integers(0, 1000),
    }
)


@given(st.integers(2, 200), CHANGES)
def test_a_split_holds_out_every_nth_and_keeps_the_exact_share_hr(
    configured: Make, views: int, changes: dict[str, Any]
) -> None:
    """It is a function of its config; its parts are disjoint and ordered, and cover all views."""
    conf = configured(**changes)
    parts = split_views(names(views), conf)
    assert parts == split_views(names(views), configured(**changes))
    assert sorted(parts.test + parts.hr + parts.lr) == list(range(views))
    for part in (parts.test, parts.hr, parts.lr):
        assert list(part) == sorted(part)
    held_out = [i for i in range(views) if conf.test_every and i % conf.test_every == 0]
    assert list(parts.test) == held_out
    train = views - len(held_out)
    assert len(parts.hr) == min(train, max(conf.min_hr, round(conf.hr_fraction * train)))


def test_another_seed_chooses_other_views_and_holds_out_the_same(configured: Make) -> None:
    a, b = split_views(names(40), configured()), split_views(names(40), configured(seed=1))
    assert a.test == b.test == (0, 8, 16, 24, 32)
    assert a.hr != b.hr


scored = st.lists(st.floats(0.01, 1), min_size=2, max_size=60, unique=True)


@pytest.fixture(scope="module")
def by_rate(configured: Make) -> Make:
    return partial(configured, tags="sampling_rate", min_hr=0)


@given(scored, st.floats(0, 1))
def test_of_scored_views_the_best_share_is_hr(
    by_rate: Make, scores: list[float], fraction: float
) -> None:
    """Test views (every 2nd) are never among them, however good."""
    conf = by_rate(hr_fraction=fraction, test_every=2)
    train = range(1, len(scores), 2)
    count = round(fraction * len(train))
    if 0 < fraction < 1 and count in (0, len(train)):
        with pytest.raises(XrgsError, match=r"variant\.hr_fraction"):
            split_views(names(len(scores)), conf, scores)
        return
    parts = split_views(names(len(scores)), conf, scores)
    best = sorted(train, key=lambda i: scores[i], reverse=True)[:count]
    assert parts.hr == tuple(sorted(best))
    assert parts.lr == tuple(i for i in train if i not in best)


@pytest.mark.parametrize(
    ("change", "scores", "high"),
    [
        ({"hr_fraction": 0.5}, [1, 0.5, 0.5, 0.5, 0.5, 0.2], (0, 1, 2, 3, 4)),
        ({"hr_fraction": 0.5}, [0.5, nan, 1, nan, nan], (2,)),
        ({"hr_above": 0.75}, [1, 0.75, 0.7499, 0.1], (0, 1)),
    ],
    ids=["equal scores are of one class", "without a score LR", "a threshold is inclusive"],
)
def test_views_of_scores_at_a_border(
    by_rate: Make, change: dict[str, float], scores: list[float], high: tuple[int, ...]
) -> None:
    conf = by_rate(test_every=0, **change)
    assert split_views(names(len(scores)), conf, scores).hr == high


def test_one_factor_brings_the_longest_side_to_long_side(configured: Make) -> None:
    sizes = [(2000, 1500), (1000, 4000), (640, 480)]
    assert shrink_factor(sizes, 1000) == 0.25
    assert shrink_factor(sizes, 0) == 1
    assert shrink_factor(sizes, 9000) == 1


@given(st.integers(60, 5000), st.integers(60, 5000), st.integers(0, 3000), st.integers(1, 8))
def test_an_hr_view_is_a_whole_number_of_lr_pixels_and_never_enlarged(
    configured: Make, width: int, height: int, side: int, factor: int
) -> None:
    conf = configured(long_side=side, factor=factor)
    shrink = min(1, (side or max(width, height)) / max(width, height))
    if min(round(width * shrink), round(height * shrink)) // factor < WINDOW:
        with pytest.raises(XrgsError, match="smaller than the SSIM window"):
            hr_geometry((width, height), shrink_factor([(width, height)], conf.long_side), conf)
        return
    made = hr_geometry((width, height), shrink_factor([(width, height)], conf.long_side), conf)
    assert made.width % factor == made.height % factor == 0
    assert made.width <= made.resized[0] <= width
    assert made.height <= made.resized[1] <= height
    assert made.resized[0] - made.width < factor
    assert max(made.resized) == min(side or 10**9, max(width, height))
    left, top = made.crop_offset
    assert abs(made.resized[0] - made.width - 2 * left) <= 1
    assert abs(made.resized[1] - made.height - 2 * top) <= 1


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"factor": 0}, "variant.factor=0"),
        ({"hr_fraction": 1.5}, "variant.hr_fraction=1.5"),
        ({"test_every": 1}, "variant.test_every=1"),
        ({"selection": "best"}, "variant.selection=best"),
        ({"hr_above": 0.5}, "variant.hr_above=0.5: not read with variant.tags=flag"),
        ({"jpeg_quality": 0}, "variant.jpeg_quality=0"),
        ({"phone": PhoneConf(blur=nan, noise=0, jpeg_quality=75)}, "variant.phone.blur=nan"),
        ({"sfm": {"first_octave": -2}}, "variant.sfm.first_octave=-2"),
        ({"sfm": {"min_inliers": 5}}, "variant.sfm.min_inliers=5"),
        ({"sfm": {"min_registered": 2}}, "variant.sfm.min_registered=2"),
    ],
)
def test_an_invalid_config_is_refused_by_its_key(
    configured: Make, change: dict[str, Any], key: str
) -> None:
    with pytest.raises(XrgsError, match=key):
        check_variant_conf(configured(**change))
    check_variant_conf(configured())


def test_every_documented_limit_is_accepted(configured: Make) -> None:
    changes: tuple[dict[str, Any], ...] = (
        {
            "factor": 1,
            "hr_fraction": 0.0,
            "min_hr": 0,
            "long_side": 0,
            "test_every": 0,
            "selection": "random",
            "tags": "distance",
            "hr_above": 1.0,
            "jpeg_quality": 1,
            "phone": PhoneConf(blur=0, noise=0, jpeg_quality=1),
            "sfm": {"min_registered": 0.0, "max_num_features": 0, "first_octave": None},
        },
        {
            "hr_fraction": 1.0,
            "test_every": 2,
            "selection": "uniform",
            "jpeg_quality": 95,
            "phone": PhoneConf(blur=10, noise=255, jpeg_quality=95),
            "sfm": {"min_registered": 1.0, "first_octave": -1, "min_inliers": 6},
        },
        {"degradation": "auto", "sfm": {"first_octave": 0, "lr_images": "native"}},
        *({"degradation": name} for name in ("none", *DEGRADATIONS)),
        *({"sfm": {"camera": name}} for name in ("auto", "single", "per_image")),
    )
    for change in changes:
        check_variant_conf(configured(**change))


def test_named_views_are_held_out_in_place_of_every_nth(configured: Make) -> None:
    conf = configured(test=["view_005", "view_002"], test_every=3)
    parts = split_views(names(9), conf)
    assert parts.test == (2, 5)
    assert sorted(parts.hr + parts.lr) == [0, 1, 3, 4, 6, 7, 8]


def test_an_unknown_test_view_is_refused_with_the_nearest_name(configured: Make) -> None:
    check_test_names(names(9), configured(test=["view_004"]))
    message = r"variant\.test: the scene has no view view_04\.png; did you mean view_004\?"
    with pytest.raises(XrgsError, match=message):
        check_test_names(names(9), configured(test=["view_003", "view_04.png"]))


@pytest.mark.parametrize(
    ("given", "names", "word"),
    [
        (["c", "a", "b", "d"], ["a, b", "c", "d"], '\'variant.test=["c","a, b","d"]\''),
        (["1007100"], ["100_7100"], "'variant.test=[\"100_7100\"]'"),
        (["q"], ["aq", "'q'"], """'variant.test=["'"'"'q'"'"'"]'"""),
        (["True"], ["true", "a"], "'variant.test=[\"true\"]'"),
    ],
)
def test_a_name_that_needs_quotes_is_answered_with_the_word_to_type(
    configured: Make, given: list[str], names: list[str], word: str
) -> None:
    with pytest.raises(XrgsError) as caught:
        check_test_names(names, configured(test=given))
    assert f" On a command line it is {word}, in a file of YAML test: [" in str(caught.value)


def test_a_uniform_selection_is_evenly_spaced(configured: Make) -> None:
    conf = configured(selection="uniform", test_every=0, hr_fraction=0.25, min_hr=0)
    assert split_views(names(16), conf).hr == (2, 6, 10, 14)


def test_a_factor_too_large_for_the_ssim_window_is_named(configured: Make) -> None:
    with pytest.raises(XrgsError, match=r"variant\.factor=40: LR views of 12x9 px .*SSIM window"):
        hr_geometry((504, 378), 1.0, configured(factor=40))
    with pytest.raises(XrgsError, match=r"^views of 9x10 px are smaller than the SSIM window"):
        hr_geometry((9, 10), 1.0, configured(factor=1))
