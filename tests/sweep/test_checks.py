"""Configs with which every cell would fail are refused when a sweep is planned."""

from collections.abc import Callable

import pytest

from xrgs.capture.dataset import USES
from xrgs.config import TRAINING_VIEWS, Conf
from xrgs.errors import XrgsError
from xrgs.sweep.checks import check


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("variant.factor=0", "variant.factor=0: must be 1 or more"),
        ("variant.sfm.camera=two", "variant.sfm.camera=two"),
        ("variant.long_side=29", "variant.long_side=29: must be 0 .* or at least 30"),
    ],
)
def test_what_no_variant_can_be_made_of_is_refused(
    compose: Callable[..., Conf], override: str, message: str
) -> None:
    with pytest.raises(XrgsError, match=message):
        check(compose(override))


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("variant.long_side=0",),
        ("variant.long_side=30",),
        ("variant.long_side=6", "variant.degradation=jpeg"),
    ],
)
def test_what_may_succeed_is_let_through(
    compose: Callable[..., Conf], overrides: tuple[str, ...]
) -> None:
    check(compose(*overrides))


@pytest.mark.parametrize("override", ["seed=-1", "variant.seed=-1", "train.views=foo"])
def test_seeds_and_kinds_of_views_are_checked_with_the_config(
    compose: Callable[..., Conf], override: str
) -> None:
    with pytest.raises(XrgsError, match=override):
        compose(override)


def test_the_kinds_of_views_are_those_that_are_loaded() -> None:
    assert TRAINING_VIEWS == USES
